// Turns the 3-D view of calibration_view.js: mouse, touch, keys, buttons and sliders; and its picture for paper.
(function () {
  "use strict";
  const { data, scene, state, HOME, FACTORS, SHADES, draw, camera, top, errors, good, robotOf, usualFactor } = calibrationView;
  const byId = (id) => document.getElementById(id + "-3d");
  const canvas = byId("canvas"), figure = byId("figure"), image = byId("snapshot");
  const pen = canvas.getContext("2d");
  if (!pen || !scene.points.length) return; // the drawing without JavaScript stays

  // ── screen, paper ─────────────────────────────────────────────────────────────────────────────────

  let waiting = false;
  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const ratio = Math.min(window.devicePixelRatio || 1, 3), box = canvas.getBoundingClientRect();
      if (!box.width) return;
      canvas.width = Math.round(box.width * ratio);
      canvas.height = Math.round(box.height * ratio);
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      canvas.dataset.arrows = draw(pen, box.width, box.height);
      canvas.dataset.points = scene.points.length;
    });
  }

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

  function set(changes) {
    Object.assign(state, changes);
    state.pitch = Math.max(-1.57, Math.min(1.57, state.pitch));
    state.zoom = Math.max(0.3, Math.min(12, state.zoom));
    byId("robot").value = state.robot;
    byId("factor").textContent = state.factor;
    readout();
    redraw();
  }

  function setFactor(index) {
    byId("magnify").value = index;
    set({ factor: FACTORS[index] });
  }

  function setRobot(index) {
    const robot = Math.max(0, Math.min(scene.robot_rows.length - 1, index));
    set({ robot: robot, point: scene.rows.indexOf(scene.robot_rows[robot]) });
  }

  function pick(x, y) {
    const box = canvas.getBoundingClientRect(), see = camera(box.width, box.height);
    let best = -1, nearest = 16;
    scene.points.forEach((p, i) => {
      const at = see(p), apart = Math.hypot(at.x - x + box.left, at.y - y + box.top);
      if (apart < nearest) [best, nearest] = [i, apart];
    });
    const robot = best < 0 ? undefined : robotOf.get(scene.rows[best]);
    set({ point: best, robot: robot === undefined ? state.robot : robot });
  }

  const fingers = new Map();
  let travelled = 0;
  canvas.addEventListener("pointerdown", (event) => {
    if (!fingers.size) travelled = 0;
    fingers.set(event.pointerId, event);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const [dx, dy] = [event.clientX - last.clientX, event.clientY - last.clientY];
    const others = [...fingers.values()].filter((f) => f.pointerId !== event.pointerId);
    const apart = (f) => Math.hypot(f.clientX - others[0].clientX, f.clientY - others[0].clientY);
    const zoom = others.length ? apart(event) / Math.max(apart(last), 1) : 1;
    fingers.set(event.pointerId, event);
    travelled += Math.hypot(dx, dy);
    const share = others.length ? 0.5 : 1;
    set({ yaw: state.yaw - 0.008 * share * dx, pitch: state.pitch + 0.008 * share * dy, zoom: state.zoom * zoom });
  });
  const release = (event) => {
    if (fingers.delete(event.pointerId) && event.type === "pointerup" && travelled < 5) pick(event.clientX, event.clientY);
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // the page scrolls on
    event.preventDefault();
    set({ zoom: state.zoom * Math.exp(-0.0015 * event.deltaY) });
  }, { passive: false });
  canvas.addEventListener("dblclick", () => set(HOME));

  const KEYS = {
    ArrowLeft: () => set({ yaw: state.yaw + 0.1 }), ArrowRight: () => set({ yaw: state.yaw - 0.1 }),
    ArrowUp: () => set({ pitch: state.pitch + 0.1 }), ArrowDown: () => set({ pitch: state.pitch - 0.1 }),
    "+": () => set({ zoom: state.zoom * 1.2 }), "=": () => set({ zoom: state.zoom * 1.2 }), "-": () => set({ zoom: state.zoom / 1.2 }),
    PageDown: () => setRobot(state.robot + 1), PageUp: () => setRobot(state.robot - 1), 0: () => set(HOME),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key] || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    KEYS[event.key]();
  });

  const VIEWS = { front: { yaw: 0, pitch: 0 }, side: { yaw: -Math.PI / 2, pitch: 0 }, top: { yaw: -Math.PI / 2, pitch: 1.57 }, reset: HOME };
  for (const button of document.querySelectorAll("[data-view]")) button.addEventListener("click", () => set(VIEWS[button.dataset.view]));
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
  window.addEventListener("resize", redraw);
})();
