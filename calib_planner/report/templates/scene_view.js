// The 3-D view of a scene (report/scene.py): what is drawn and from where it is seen; scene_controls.js turns it.
// A camera orbits a fixed centre; everything is drawn far to near on a 2-D canvas, in perspective.
// World: axes of the robot's base, z up [m]. Screen: pixels of the page. No library, no WebGL.
function sceneView(scene) {
  "use strict";
  const count = scene.points.length;

  const HOME = { yaw: -0.87, pitch: 0.38, zoom: 1 };
  const FACTORS = Array.from({ length: 16 }, (_, i) => [1, 2, 5][i % 3] * 10 ** Math.floor(i / 3));
  const SHADES = [[158, 188, 218], [140, 150, 198], [140, 107, 177], [136, 65, 157], [110, 1, 107]];
  const INK = "#16202a", SOFT = "#5b6770", GROSS = "#d55e00", TEST = "#00805a", ARM = "#35516b", AHEAD = "#0072b2";
  const REJECTED = 2, MOST_ARROWS = 400;

  // ── what does not change ──────────────────────────────────────────────────────────────────────────

  const length = (v) => Math.hypot(v[0], v[1], v[2]);
  const plus = (a, b, k) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
  const quantile = (values, p) => values.slice().sort((a, b) => a - b)[Math.floor(p * (values.length - 1))] || 0;
  const errors = { after: scene.after.map(length), before: scene.before.map(length) };
  const good = scene.states.map((s) => s !== REJECTED);
  const top = {};
  for (const when of ["after", "before"]) top[when] = quantile(errors[when].filter((_, i) => good[i]), 0.95) || 1e-6;
  const arrowed = {}; // points whose error vector is drawn: the largest where they are many
  for (const when of ["after", "before"]) {
    const least = errors[when].filter((_, i) => good[i]).sort((a, b) => b - a)[MOST_ARROWS - 1] || 0;
    arrowed[when] = errors[when].map((e, i) => good[i] && e >= least);
  }
  const robotOf = new Map(scene.robot_rows.map((row, i) => [row, i]));
  const ahead = scene.robot_rows.flatMap((row, i) => (scene.ahead && scene.ahead.includes(row) ? [i] : []));
  const targetOf = (i) => scene.robots[i][scene.robots[i].length - 1];
  const solid = [[[0, 0, 0]], scene.now || [], scene.extent || [], scene.robots.flat(), scene.test_robots.flat(), scene.points.filter((_, i) => good[i])].flat();
  const bounds = boundsOf(solid);
  const step = [0.1, 0.2, 0.5, 1, 2, 5, 10].find((s) => bounds.radius / s < 5) || 20;

  function boundsOf(points) {
    const low = [0, 0, 0], high = [0, 0, 0];
    for (const p of points) for (let a = 0; a < 3; a++) {
      low[a] = Math.min(low[a], p[a]);
      high[a] = Math.max(high[a], p[a]);
    }
    return { centre: low.map((v, a) => (v + high[a]) / 2), radius: length(low.map((v, a) => high[a] - v)) / 2 || 1 };
  }

  // ── what the user changes ─────────────────────────────────────────────────────────────────────────

  const state = { ...HOME, when: "after", factor: 1, robot: 0, point: -1 };

  function usualFactor() {
    const wanted = 0.12 * bounds.radius / top[state.when];
    const index = FACTORS.findIndex((f) => f > wanted);
    return Math.max(0, (index < 0 ? FACTORS.length : index) - 1);
  }

  // ── camera ────────────────────────────────────────────────────────────────────────────────────────

  function camera(width, height) {
    const [sy, cy, sp, cp] = [Math.sin(state.yaw), Math.cos(state.yaw), Math.sin(state.pitch), Math.cos(state.pitch)];
    const far = 3.2 * bounds.radius, size = state.zoom * Math.min(width / spread.x, height / spread.y);
    return projection(sy, cy, sp, cp, far, size, width, height - 2 * spread.middle * size);
  }

  function projection(sy, cy, sp, cp, far, size, width, height) {
    return (p) => {
      const [x, y, z] = plus(p, bounds.centre, -1);
      const forward = -(x * cy + y * sy) * cp - z * sp;
      const scale = size * far / Math.max(far + forward, 0.05 * far);
      const up = -(x * cy + y * sy) * sp + z * cp;
      return { x: width / 2 + (-x * sy + y * cy) * scale, y: height / 2 - up * scale, depth: forward, scale: scale };
    };
  }

  function homeSpread() { // how far everything reaches on the screen, at scale 1, while the view turns once round
    const [sp, cp] = [Math.sin(HOME.pitch), Math.cos(HOME.pitch)];
    let [wide, low, high] = [1e-9, -1e-9, 1e-9];
    for (let k = 0; k < 12; k++) {
      const yaw = HOME.yaw + k * Math.PI / 6;
      const see = projection(Math.sin(yaw), Math.cos(yaw), sp, cp, 3.2 * bounds.radius, 1, 0, 0);
      for (const at of solid.map(see)) {
        wide = Math.max(wide, 2 * Math.abs(at.x));
        [low, high] = [Math.min(low, at.y), Math.max(high, at.y)];
      }
    }
    return { x: 1.1 * wide, y: 1.2 * (high - low), middle: (low + high) / 2 };
  }
  const spread = homeSpread();

  function shade(error) {
    const at = Math.min(error / top[state.when], 1) * (SHADES.length - 1), i = Math.min(Math.floor(at), SHADES.length - 2);
    const mix = SHADES[i].map((c, k) => Math.round(c + (SHADES[i + 1][k] - c) * (at - i)));
    return `rgb(${mix})`;
  }

  // ── drawing ───────────────────────────────────────────────────────────────────────────────────────

  function draw(pen, width, height) {
    const see = camera(width, height), items = [];
    pen.fillStyle = "#fff";
    pen.fillRect(0, 0, width, height);
    floor(pen, see);
    const vectors = state.when === "after" ? scene.after : scene.before;
    const radius = Math.max(2, Math.min(4.5, 60 / Math.sqrt(count)));
    let arrows = 0;
    scene.points.forEach((p, i) => {
      const at = see(p), colour = good[i] ? shade(errors[state.when][i]) : GROSS;
      items.push({ depth: at.depth, paint: () => mark(pen, at, i, radius, colour) });
      if (!arrowed[state.when][i] && state.point !== i) return;
      const long = Math.min(state.factor, 0.5 * bounds.radius / Math.max(errors[state.when][i], 1e-12));
      const from = see(plus(p, vectors[i], -1)), to = see(plus(p, vectors[i], long - 1));
      arrows += 1;
      items.push({ depth: at.depth - 1e-6, paint: () => arrow(pen, from, to, colour, long < state.factor) });
    });
    scene.test_robots.forEach((body) => body_items(items, pen, see, body, TEST, 2, true));
    for (const i of ahead) {
      const at = see(targetOf(i));
      items.push({ depth: at.depth, paint: () => disc(pen, at, i === state.robot ? 7 : 4.5, "#fff", AHEAD) });
    }
    const thick = 0.035 * bounds.radius, chosen = scene.robots[state.robot];
    if (scene.now && chosen) body_items(items, pen, see, chosen, AHEAD, 2.5, true);
    if (scene.now || chosen) body_items(items, pen, see, scene.now || chosen, ARM, thick, false);
    if (scene.tracker) items.push(station(pen, see(scene.tracker), width, height), beam(pen, see));
    items.sort((a, b) => b.depth - a.depth);
    for (const item of items) item.paint();
    axes(pen, see);
    caption(pen, height);
    return arrows;
  }

  function line(pen, a, b, colour, width, dash) {
    pen.beginPath();
    pen.setLineDash(dash || []);
    pen.moveTo(a.x, a.y);
    pen.lineTo(b.x, b.y);
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.stroke();
    pen.setLineDash([]);
  }

  function disc(pen, at, radius, fill, edge) {
    pen.beginPath();
    pen.arc(at.x, at.y, radius, 0, 7);
    pen.fillStyle = fill;
    pen.fill();
    if (edge) { pen.strokeStyle = edge; pen.lineWidth = 1.2; pen.stroke(); }
  }

  function text(pen, words, x, y, colour, align) {
    pen.font = "12px Arial, 'Liberation Sans', sans-serif";
    pen.textAlign = align || "left";
    pen.lineWidth = 3;
    pen.strokeStyle = "rgba(255,255,255,.85)";
    pen.strokeText(words, x, y);
    pen.fillStyle = colour;
    pen.fillText(words, x, y);
  }

  function floor(pen, see) {
    const n = Math.ceil(bounds.radius / step), [cx, cy] = bounds.centre.map((c) => Math.round(c / step));
    for (let i = -n; i <= n; i++) {
      line(pen, see([(cx + i) * step, (cy - n) * step, 0]), see([(cx + i) * step, (cy + n) * step, 0]), "#e3e8eb", 1);
      line(pen, see([(cx - n) * step, (cy + i) * step, 0]), see([(cx + n) * step, (cy + i) * step, 0]), "#e3e8eb", 1);
    }
  }

  function mark(pen, at, i, radius, colour) {
    if (!good[i]) {
      line(pen, { x: at.x - 5, y: at.y - 5 }, { x: at.x + 5, y: at.y + 5 }, colour, 2.2);
      line(pen, { x: at.x - 5, y: at.y + 5 }, { x: at.x + 5, y: at.y - 5 }, colour, 2.2);
    } else disc(pen, at, radius, colour, count < 800 ? "rgba(22,32,42,.55)" : null);
    if (scene.states[i] === 1) disc(pen, at, radius + 4, "transparent", GROSS);
    if (state.point === i) disc(pen, at, radius + 7, "transparent", INK);
  }

  function arrow(pen, from, to, colour, cut) {
    line(pen, from, to, colour, count > 800 ? 1.3 : 1.8, cut ? [4, 3] : null);
    const [dx, dy] = [to.x - from.x, to.y - from.y], long = Math.hypot(dx, dy);
    if (long < 7 || cut) return;
    const [ux, uy] = [dx / long, dy / long];
    pen.beginPath();
    pen.moveTo(to.x, to.y);
    pen.lineTo(to.x - 6 * ux + 3 * uy, to.y - 6 * uy - 3 * ux);
    pen.lineTo(to.x - 6 * ux - 3 * uy, to.y - 6 * uy + 3 * ux);
    pen.fillStyle = colour;
    pen.fill();
  }

  function body_items(items, pen, see, body, colour, thickness, ghost) {
    const arm = body.slice(0, body.length - scene.target_count), tip = arm[arm.length - 1];
    const seen = arm.map(see);
    const wide = (at) => (ghost ? thickness : Math.max(3, thickness * at.scale));
    pen.lineCap = "round";
    for (let i = 1; i < seen.length; i++) {
      const [a, b] = [seen[i - 1], seen[i]];
      items.push({ depth: (a.depth + b.depth) / 2, paint: () => line(pen, a, b, colour, wide(b), ghost ? [5, 4] : null) });
      if (!ghost && i < seen.length - 1) items.push({ depth: b.depth - 1e-4, paint: () => disc(pen, b, 0.55 * wide(b), "#fff", INK) });
    }
    for (const target of body.slice(arm.length)) {
      const [a, b] = [see(tip), see(target)];
      items.push({ depth: b.depth, paint: () => {
        line(pen, a, b, colour, 1.6);
        disc(pen, b, ghost ? 5 : 3, ghost ? colour : "#fff", ghost ? "#fff" : INK);
      } });
    }
  }

  function station(pen, at, width, height) {
    const inside = { x: Math.max(60, Math.min(width - 60, at.x)), y: Math.max(34, Math.min(height - 34, at.y)) };
    if (inside.x !== at.x || inside.y !== at.y) return { depth: -Infinity, paint: () => {
      const way = Math.atan2(at.y - height / 2, at.x - width / 2), tip = plus2(inside, way, 14);
      line(pen, plus2(inside, way, -14), tip, INK, 2);
      for (const turn of [2.6, -2.6]) line(pen, tip, plus2(tip, way + turn, 8), INK, 2);
      text(pen, `tracker, ${length(scene.tracker).toFixed(1)} m`, inside.x, inside.y - 18, INK, "center");
    } };
    return { depth: at.depth, paint: () => {
      pen.fillStyle = INK;
      pen.fillRect(at.x - 6, at.y - 8, 12, 12);
      for (const dx of [-7, 0, 7]) line(pen, { x: at.x, y: at.y + 4 }, { x: at.x + dx, y: at.y + 15 }, INK, 1.6);
      text(pen, "tracker", at.x, at.y - 13, INK, "center");
    } };
  }

  const plus2 = (p, way, by) => ({ x: p.x + by * Math.cos(way), y: p.y + by * Math.sin(way) });

  function beam(pen, see) {
    const body = scene.now || scene.robots[state.robot];
    const to = state.point >= 0 ? scene.points[state.point] : body ? body[body.length - 1] : scene.tracker;
    const [a, b] = [see(scene.tracker), see(to)];
    return { depth: Math.max(a.depth, b.depth), paint: () => line(pen, a, b, "#c2410c", 1, [3, 3]) };
  }

  function axes(pen, see) {
    const zero = see([0, 0, 0]);
    [["x", "#b3201e"], ["y", "#1b6e3c"], ["z", "#0050a0"]].forEach(([name, colour], a) => {
      const end = see([0, 1, 2].map((k) => (k === a ? 0.7 * step : 0)));
      line(pen, zero, end, colour, 2.5);
      text(pen, name, end.x + 4, end.y + 4, colour);
    });
  }

  function caption(pen, height) {
    const which = good.filter(Boolean).length > MOST_ARROWS ? `, the ${MOST_ARROWS} largest` : "";
    const vectors = errors[state.when].some((e) => e > 0) ? ` · error vectors × ${state.factor}, ${state.when} calibration${which}` : "";
    text(pen, `grid ${step} m${vectors}`, 8, height - 9, SOFT);
  }

  // What can be clicked: the measured points, and the targets of robots that are ahead; where it is, and what it stands for.
  const places = [...scene.points.map((p, i) => ({ at: p, point: i })), ...ahead.map((i) => ({ at: targetOf(i), robot: i }))];

  return { scene, state, HOME, FACTORS, SHADES, draw, camera, top, errors, good, places, robotOf, usualFactor };
}
