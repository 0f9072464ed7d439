// The two charts of the live page, as SVG: logarithmic upwards, in pixels of the page so that texts keep their size.
const liveCharts = (function () {
  "use strict";
  const NAMESPACE = "http://www.w3.org/2000/svg", LEFT = 58, RIGHT = 12, TOP = 12, BOTTOM = 30;

  function shape(tag, attributes, words) {
    const made = document.createElementNS(NAMESPACE, tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    if (words !== undefined) made.textContent = words;
    return made;
  }

  // The axes for x from 0 to `most` and y over `values`; gives where a value lies, or null where there is nothing to show.
  function axes(svg, most, values, unit) {
    const width = svg.clientWidth || 480, height = svg.clientHeight || 240;
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.replaceChildren();
    const good = values.filter((v) => v > 0);
    if (!good.length) {
      svg.append(shape("text", { x: width / 2, y: height / 2, "text-anchor": "middle" }, "nothing yet"));
      return null;
    }
    const low = Math.log10(Math.min(...good)) - 0.16, high = Math.log10(Math.max(...good)) + 0.08;
    const [bottom, top] = high - low < 0.5 ? [(low + high) / 2 - 0.25, (low + high) / 2 + 0.25] : [low, high];
    const x = (v) => LEFT + (width - LEFT - RIGHT) * v / Math.max(most, 1);
    const y = (v) => TOP + (height - TOP - BOTTOM) * (top - Math.log10(v)) / (top - bottom);
    for (const v of ticks(bottom, top)) {
      svg.append(shape("path", { class: "grid", d: `M${LEFT} ${y(v).toFixed(1)}H${width - RIGHT}` }));
      svg.append(shape("text", { x: LEFT - 6, y: (y(v) + 4).toFixed(1), "text-anchor": "end" }, String(Number(v.toPrecision(2)))));
    }
    const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000].find((s) => most / s <= Math.max(2, (width - LEFT) / 60)) || 5000;
    for (let v = 0; v <= most; v += step) {
      svg.append(shape("text", { x: x(v).toFixed(1), y: height - 12, "text-anchor": "middle" }, String(v)));
    }
    svg.append(shape("path", { class: "axis", fill: "none", d: `M${LEFT} ${TOP}V${height - BOTTOM}H${width - RIGHT}` }));
    svg.append(shape("text", { x: width - RIGHT, y: height - 1, "text-anchor": "end" }, unit));
    return { x, y, width };
  }

  function ticks(bottom, top) {
    const found = [];
    const parts = top - bottom > 2.2 ? [1] : top - bottom > 1.2 ? [1, 3] : top - bottom > 0.7 ? [1, 2, 5] : [1, 1.5, 2, 3, 4, 5, 7];
    for (let decade = Math.floor(bottom); decade <= Math.ceil(top); decade++) {
      for (const part of parts) {
        const value = part * 10 ** decade;
        if (Math.log10(value) >= bottom && Math.log10(value) <= top) found.push(value);
      }
    }
    return found;
  }

  function level(svg, at, value, kind, words) {
    if (!(value > 0)) return;
    const y = at.y(value).toFixed(1);
    svg.append(shape("path", { class: kind, d: `M${LEFT} ${y}H${at.width - RIGHT}` }));
    if (words) svg.append(shape("text", { class: "label", x: LEFT + 6, y: Number(y) + 15 }, words));
  }

  function accuracy(svg, { live, rounds, required }) {
    const all = [...live, ...rounds], most = Math.max(1, ...all.map(([n]) => n));
    const at = axes(svg, most, [...all.map(([, v]) => v), required || 0], "measurements");
    if (!at) return;
    for (const [n, v] of live) if (v > 0) svg.append(shape("circle", { class: "dot", cx: at.x(n).toFixed(1), cy: at.y(v).toFixed(1), r: 3 }));
    const good = rounds.filter(([, v]) => v > 0);
    if (good.length > 1) svg.append(shape("polyline", { class: "rounds", points: good.map(([n, v]) => `${at.x(n).toFixed(1)},${at.y(v).toFixed(1)}`).join(" ") }));
    for (const [n, v] of good) svg.append(shape("circle", { class: "round", cx: at.x(n).toFixed(1), cy: at.y(v).toFixed(1), r: 4.5 }));
    level(svg, at, required, "limit", `required ${required ? required.toFixed(4) : ""} mm`);
  }

  function residuals(svg, data) {
    const points = data.points, most = Math.max(1, ...points.map(([n]) => n));
    const at = axes(svg, most, [...points.map(([, v]) => v), points.length ? data.left_out || 0 : 0], "measurement");
    if (!at) return;
    for (const [n, v, used] of points) {
      if (!(v > 0)) continue;
      const [x, y] = [at.x(n).toFixed(1), at.y(v).toFixed(1)];
      svg.append(used ? shape("circle", { class: "dot", cx: x, cy: y, r: 3.4 }) : shape("path", { class: "cross", d: `M${x - 4} ${y - 4}l8 8m0-8l-8 8` }));
    }
    level(svg, at, data.left_out, "dash");
  }

  function drawing(posture) {
    const svg = shape("svg", { class: "posture", viewBox: `0 0 ${posture.size}`, role: "img", "aria-label": posture.title });
    for (const [tag, attributes, words] of posture.shapes) svg.append(shape(tag, attributes, tag === "text" ? words : undefined));
    return svg;
  }

  return { accuracy, residuals, drawing };
})();
