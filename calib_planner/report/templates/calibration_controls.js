// The 3-D view of a calibration report: what was chosen in words, its sliders, and its picture for paper.
const calibrationView = (function () {
  "use strict";
  const data = JSON.parse(document.getElementById("report-data").textContent), scene = data.scene, view = sceneView(scene);
  const { state, FACTORS, SHADES, draw, top, errors, good, robotOf, usualFactor } = view;
  const byId = (id) => document.getElementById(id + "-3d");
  const canvas = byId("canvas"), figure = byId("figure"), image = byId("snapshot");
  if (!canvas.getContext("2d") || !scene.points.length) return view; // the drawing without JavaScript stays
  const { set, setRobot } = sceneControls(canvas, () => view, () => {
    byId("robot").value = state.robot;
    byId("factor").textContent = state.factor;
    readout();
  });

  function snapshot() {
    const paper = document.createElement("canvas"), ratio = 2;
    [paper.width, paper.height] = [900 * ratio, 520 * ratio];
    const ink = paper.getContext("2d");
    ink.scale(ratio, ratio);
    draw(ink, 900, 520);
    image.src = paper.toDataURL("image/png");
  }

  // ── controls ──────────────────────────────────────────────────────────────────────────────────────

  const mm = (metres) => `${(1e3 * metres).toFixed(4)} mm`;

  function angles(row) {
    return scene.q[row].map((v, k) => `${scene.joint_names[k]} ${scene.revolute[k] ? (v * 180 / Math.PI).toFixed(2).replace("-", "−") + "°" : mm(v)}`).join(", ");
  }

  function readout() {
    const i = state.point, row = i >= 0 ? scene.rows[i] : scene.robot_rows[state.robot];
    if (row === undefined) return;
    byId("row").textContent = `row ${row}`;
    let words = `Row ${row}: ${angles(row)}.`;
    const target = i >= 0 ? scene.targets[i] - 1 : -1;
    if (i >= 0) {
      const sigmas = data.estimate.normalised_residuals[row][target];
      words += ` Target ${target + 1}: ${mm(data.distances_before[row][target])} before, ${mm(data.distances_after[row][target])} after`;
      words += sigmas === null ? "" : `, ${sigmas.toFixed(1)} standard deviations`;
      words += [".", ": beyond the gate, but used.", ": rejected."][scene.states[i]];
      if (!robotOf.has(row)) words += " Its robot is not among those drawn.";
    }
    byId("readout").textContent = words;
  }

  function showScale() {
    const colours = SHADES.map((c) => `rgb(${c})`).join(",");
    const box = byId("scale"), bar = document.createElement("i");
    bar.style.background = `linear-gradient(90deg,${colours})`;
    const items = [" test pose (green, dashed)", " rejected ×"].filter((_, k) => (k ? good.includes(false) : scene.test_robots.length));
    box.replaceChildren(`Error ${state.when}: 0`, bar, `${(1e3 * top[state.when]).toPrecision(3)} mm and more (the largest 5 %).`, items.length ? " Also:" + items.join(",") + "." : "");
    box.hidden = false;
  }

  function setFactor(index) {
    byId("magnify").value = index;
    set({ factor: FACTORS[index] });
  }

  for (const choice of document.querySelectorAll("[name=when-3d]")) choice.addEventListener("change", () => {
    state.when = choice.value;
    showScale();
    setFactor(usualFactor());
  });
  byId("robot").max = Math.max(0, scene.robot_rows.length - 1);
  byId("robot").addEventListener("input", (event) => setRobot(Number(event.target.value)));
  byId("magnify").addEventListener("input", (event) => setFactor(Number(event.target.value)));

  figure.classList.add("live");
  for (const part of [canvas, byId("controls"), byId("readout")]) part.hidden = false;
  const worst = errors.after.reduce((best, e, i) => (good[i] && e > errors.after[best] || !good[best] ? i : best), 0);
  showScale();
  setFactor(usualFactor());
  set({ robot: robotOf.get(scene.rows[worst]) || 0, point: worst });
  snapshot();
  window.addEventListener("beforeprint", snapshot);
  window.addEventListener("beforeprint", () => {
    document.querySelectorAll("details").forEach((d) => { d.open = true; });
  });
  return view;
})();
