// Turns a view of scene_view.js on a canvas: mouse, touch, keys and the buttons with data-view.
// `view()` gives the view in use, which the page may replace; `changed()` tells the page that what is seen was changed.
function sceneControls(canvas, view, changed) {
  "use strict";
  const pen = canvas.getContext("2d");

  let waiting = false;
  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const ratio = Math.min(window.devicePixelRatio || 1, 3), box = canvas.getBoundingClientRect();
      if (!box.width || !view()) return;
      canvas.width = Math.round(box.width * ratio);
      canvas.height = Math.round(box.height * ratio);
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      canvas.dataset.arrows = view().draw(pen, box.width, box.height);
      canvas.dataset.points = view().scene.points.length;
    });
  }

  function set(changes) {
    const { state } = view();
    Object.assign(state, changes);
    state.pitch = Math.max(-1.57, Math.min(1.57, state.pitch));
    state.zoom = Math.max(0.3, Math.min(12, state.zoom));
    changed();
    redraw();
  }

  function setRobot(index) {
    const { scene } = view(), robot = Math.max(0, Math.min(scene.robot_rows.length - 1, index));
    set({ robot: robot, point: scene.rows.indexOf(scene.robot_rows[robot]) });
  }

  function pick(x, y) {
    const { scene, state, places, camera, robotOf } = view(), box = canvas.getBoundingClientRect();
    const see = camera(box.width, box.height);
    let best = {}, nearest = 16;
    for (const place of places) {
      const at = see(place.at), apart = Math.hypot(at.x - x + box.left, at.y - y + box.top);
      if (apart < nearest) [best, nearest] = [place, apart];
    }
    const robot = best.point === undefined ? best.robot : robotOf.get(scene.rows[best.point]);
    set({ point: best.point === undefined ? -1 : best.point, robot: robot === undefined ? state.robot : robot });
  }

  const fingers = new Map();
  let travelled = 0;
  canvas.addEventListener("pointerdown", (event) => {
    if (!fingers.size) travelled = 0;
    fingers.set(event.pointerId, event);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId), { state } = view();
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
    set({ zoom: view().state.zoom * Math.exp(-0.0015 * event.deltaY) });
  }, { passive: false });
  canvas.addEventListener("dblclick", () => set(view().HOME));

  const turned = (by) => ({ yaw: view().state.yaw + by }), tilted = (by) => ({ pitch: view().state.pitch + by });
  const zoomed = (by) => ({ zoom: view().state.zoom * by });
  const KEYS = {
    ArrowLeft: () => set(turned(0.1)), ArrowRight: () => set(turned(-0.1)),
    ArrowUp: () => set(tilted(0.1)), ArrowDown: () => set(tilted(-0.1)),
    "+": () => set(zoomed(1.2)), "=": () => set(zoomed(1.2)), "-": () => set(zoomed(1 / 1.2)),
    PageDown: () => setRobot(view().state.robot + 1), PageUp: () => setRobot(view().state.robot - 1), 0: () => set(view().HOME),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key] || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    KEYS[event.key]();
  });

  const VIEWS = { front: { yaw: 0, pitch: 0 }, side: { yaw: -Math.PI / 2, pitch: 0 }, top: { yaw: -Math.PI / 2, pitch: 1.57 } };
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => set(VIEWS[button.dataset.view] || view().HOME));
  }
  window.addEventListener("resize", redraw);
  return { set, setRobot, redraw };
}
