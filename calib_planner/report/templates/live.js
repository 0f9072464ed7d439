// The live page: takes what the node sends and puts it on the screen, sends what is pressed, shows the answer.
// Texts from outside become text nodes, never markup.
(function () {
  "use strict";
  const byId = (id) => document.getElementById(id);
  const MEANING = {
    PASS: "Nothing speaks against applying the calibration.",
    WARN: "Read the reasons before you apply the calibration.",
    FAIL: "Do not apply the calibration. The reasons say what to do.",
  };

  function element(tag, kind, ...children) {
    const made = document.createElement(tag);
    if (kind) made.className = kind;
    made.append(...children);
    return made;
  }

  // ── what was sent ─────────────────────────────────────────────────────────────────────────────────

  const data = {};
  let kind = "";

  const SHOW = {
    page(page) {
      byId("robot").textContent = page.robot || "Calibration";
      byId("notice").textContent = page.notice;
      byId("notice").hidden = !page.notice;
      byId("report").hidden = !page.report;
      if (page.report) {
        byId("report-link").href = "/report/" + encodeURIComponent(page.report);
        byId("report-link").textContent = "Open the report";
      }
      title();
    },

    now(now) {
      byId("title").textContent = now.title;
      byId("reason").textContent = now.reason;
      byId("badge").textContent = now.word;
      byId("badge").className = "badge " + now.kind;
      document.body.classList.remove("is-" + kind);
      kind = now.kind;
      document.body.classList.add("is-" + kind);
      byId("progress").hidden = !now.total;
      byId("bar").max = now.total || 1;
      byId("bar").value = now.done;
      byId("count").textContent = now.count;
      title();
    },

    buttons(buttons) {
      for (const [name, { refused, waiting }] of Object.entries(buttons)) {
        const button = document.querySelector(`[data-do="${name}"]`);
        button.setAttribute("aria-busy", waiting);
        if (name === "stop") continue;
        const why = byId("why-" + name);
        button.setAttribute("aria-disabled", Boolean(refused));
        why.textContent = refused || why.dataset.hint;
      }
    },

    posture(posture) {
      byId("posture").hidden = !posture;
      if (!posture) return;
      byId("drawing").replaceChildren(liveCharts.drawing(posture));
      byId("joints").replaceChildren(...pairs(posture.joints));
    },

    numbers(rows) {
      byId("numbers").replaceChildren(...rows.map((row) => {
        const value = element("dd", "", row.value, element("small", "", row.remark));
        return element("div", row.kind, element("dt", "", row.label), value);
      }));
    },

    accuracy: charts,
    residuals: charts,

    visits(visits) {
      byId("ahead-title").textContent = `Ahead: ${visits.ahead.length}`;
      byId("done-title").textContent = `Measured: ${visits.measured}`;
      byId("ahead").replaceChildren(...listed(visits.ahead.map((row) => aheadItem(row, visits.refused)), "Nothing is planned."));
      byId("done").replaceChildren(...listed(visits.done.map(doneItem), "Nothing was measured yet."));
      byId("leave").hidden = !visits.ahead.length;
      choose();
    },

    scene: takeScene,

    here(here) {
      if (!view) return;
      view.scene.now = here;
      if (here && grown(here)) takeScene(view.scene); // the robot reaches farther than what is drawn: step back
      else controls.redraw();
    },

    verdict(verdict) {
      byId("verdict").hidden = !verdict;
      if (!verdict) return;
      byId("verdict-title").textContent = verdict.title;
      byId("judged").className = "verdict " + verdict.level;
      byId("level").textContent = verdict.level;
      byId("meaning").textContent = MEANING[verdict.level] || "";
      byId("reasons").replaceChildren(...verdict.reasons.map((f) => element("li", f.level, element("b", "", f.level),
        element("div", "", element("span", "said", f.text), element("span", "advice", f.advice)))));
    },

    streams(streams) {
      byId("no-streams").hidden = Boolean(streams.length);
      byId("stream-list").replaceChildren(...streams.map((s) => element("li", "", element("span", "state " + s.level, s.level),
        element("b", "", s.name), element("span", "", s.motion), element("small", "", s.text))));
    },

    journal(lines) {
      byId("journal").replaceChildren(...listed(lines.map((line) => {
        const when = element("time", "", new Date(1e3 * line.time).toLocaleTimeString());
        return element("li", "", when, element("span", line.kind, line.text));
      }), "Nothing was done yet."));
    },
  };

  const pairs = (joints) => joints.map(([name, value]) => element("div", "", element("dt", "", name), element("dd", "", value)));
  const listed = (items, none) => (items.length ? items : [element("li", "empty", none)]);
  const words = (joints) => joints.map(([name, value]) => `${name} ${value}`).join(", ");

  const values = (joints) => joints.map(([, value]) => value).join("  ");

  function title() {
    const { now, page } = data;
    document.title = [now && now.count, now && now.word, page && page.robot, "calibration"].filter(Boolean).join(" · ");
  }

  function charts() {
    const { accuracy, residuals } = data;
    byId("results").hidden = !(accuracy && accuracy.required) && !(residuals && residuals.points.length);
    if (byId("results").hidden) return;
    liveCharts.accuracy(byId("accuracy"), accuracy);
    liveCharts.residuals(byId("residuals"), residuals);
  }

  function aheadItem(row, refused) {
    const name = element("button", "name", `${row.number}`);
    name.type = "button";
    name.setAttribute("aria-label", `show configuration ${row.number}`);
    const what = element("span", "what", ...(row.note ? [element("b", "", row.note), " "] : []), values(row.joints));
    const item = element("li", "", name, what);
    if (row.note === "now") return chosenBy(item, row);
    const acts = element("span", "acts");
    item.append(acts);
    for (const [label, replace] of [["Leave out", false], ["Replace", true]]) {
      const button = element("button", "act", label);
      button.type = "button";
      button.setAttribute("aria-label", `${label.toLowerCase()} configuration ${row.number}`);
      button.setAttribute("aria-disabled", Boolean(refused));
      button.title = refused;
      button.addEventListener("click", (event) => {
        event.stopPropagation();
        if (refused) answer(label, false, refused);
        else press("skip_configuration", `${label} ${row.number}`, { number: row.number, replace: replace });
      });
      acts.append(button);
    }
    return chosenBy(item, row);
  }

  function doneItem(row) {
    const name = element("button", "name", `#${row.number}`);
    name.type = "button";
    name.setAttribute("aria-label", `show measurement ${row.number}`);
    const what = element("span", "what", element("b", "", row.residual), " ", row.reason || values(row.joints));
    return chosenBy(element("li", "", name, what, element("span", "word " + row.kind, row.word)), row);
  }

  function chosenBy(item, row) {
    item.dataset.key = row.key;
    item.addEventListener("click", () => {
      if (!view) return;
      const robot = view.scene.robot_rows.indexOf(row.row);
      if (robot >= 0) controls.setRobot(robot);
      if (matchMedia("(max-width: 860px)").matches) byId("view").scrollIntoView({ behavior: "smooth" });
    });
    return item;
  }

  // ── the 3-D view ──────────────────────────────────────────────────────────────────────────────────

  const canvas = byId("canvas-3d");
  let view = null, chosenKey = ""; // of a row that a person has chosen; else what is measured now or first is shown
  const controls = sceneControls(canvas, () => view, () => {
    const row = rowShown();
    if (row && row.key !== (rowChosen() || {}).key) chosenKey = row.key;
    choose();
  });

  let extent = []; // two corners of a box around all that the robot has reached [m]

  function grown(body) {
    const [low, high] = extent.length ? extent : [body[0], body[0]];
    const corners = [Math.min, Math.max].map((best, k) => [0, 1, 2].map((a) => best([low, high][k][a], ...body.map((p) => p[a]))));
    const by = Math.max(...corners.flatMap((corner, k) => corner.map((v, a) => Math.abs(v - [low, high][k][a]))));
    if (extent.length && by < 0.05 * Math.hypot(...[0, 1, 2].map((a) => high[a] - low[a]))) return false;
    extent = corners;
    return true;
  }

  function takeScene(scene) {
    byId("nothing-3d").hidden = Boolean(scene);
    if (!scene) return;
    const before = view && view.state;
    Object.assign(scene, { now: data.here || null, extent: extent });
    view = sceneView(scene);
    if (before) Object.assign(view.state, { yaw: before.yaw, pitch: before.pitch, zoom: before.zoom });
    const row = rowChosen(), robot = row ? scene.robot_rows.indexOf(row.row) : -1;
    Object.assign(view.state, { robot: robot, point: row ? scene.rows.indexOf(row.row) : -1, factor: view.FACTORS[view.usualFactor()] });
    choose();
    controls.redraw();
  }

  const rows = () => (data.visits ? [...data.visits.ahead, ...data.visits.done] : []);
  const rowChosen = () => rows().find((r) => r.key === chosenKey) || (data.visits && data.visits.ahead[0]);

  function rowShown() {
    const { scene, state } = view;
    const shown = state.point >= 0 ? scene.rows[state.point] : scene.robot_rows[state.robot];
    return rows().find((r) => r.row === shown);
  }

  function choose() { // marks the chosen row in the list, and says it in words
    const row = view && rowShown();
    for (const item of document.querySelectorAll(".list li")) item.classList.toggle("chosen", Boolean(row) && item.dataset.key === row.key);
    let said = "";
    if (row && row.word) said = `Measurement ${row.number}, ${row.word}, residual ${row.residual}: ${words(row.joints)}. ${row.reason}`;
    else if (row) said = `Configuration ${row.number}, ${row.note === "now" ? "now" : ["ahead", row.note].filter(Boolean).join(", ")}: ${words(row.joints)}.`;
    byId("readout-3d").textContent = said;
  }

  byId("before-3d").addEventListener("click", () => view && controls.setRobot(view.state.robot - 1));
  byId("after-3d").addEventListener("click", () => view && controls.setRobot(view.state.robot + 1));
  window.addEventListener("resize", charts);

  // ── buttons ───────────────────────────────────────────────────────────────────────────────────────

  function answer(label, done, text) {
    byId("answer").className = done ? "good" : "bad";
    byId("answer").textContent = `${label}: ${text}`;
  }

  async function press(name, label, values) {
    byId("answer").className = "";
    byId("answer").textContent = `${label} …`;
    try {
      const sent = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(values) };
      const came = await fetch("/do/" + name, sent);
      const { done, text } = came.headers.get("Content-Type").includes("json") ? await came.json() : { done: false, text: await came.text() };
      answer(label, done, text);
    } catch (error) {
      answer(label, false, "the page's node does not answer; nobody knows whether it was done. Use the robot's own controls.");
    }
  }

  const sure = byId("sure");
  let pending = null;
  byId("sure-yes").addEventListener("click", () => { sure.close(); if (pending) pending(); });
  byId("sure-no").addEventListener("click", () => sure.close());

  for (const button of document.querySelectorAll("[data-do]")) button.addEventListener("click", () => {
    const label = button.querySelector("b").textContent;
    if (button.getAttribute("aria-disabled") === "true") {
      answer(label, false, button.querySelector("small").textContent);
      return;
    }
    pending = () => press(button.dataset.do, label, {});
    if (!button.dataset.sure) return void pending();
    byId("sure-text").textContent = button.dataset.sure;
    byId("sure-yes").textContent = label;
    sure.showModal();
    byId("sure-no").focus();
  });

  // ── the connection ────────────────────────────────────────────────────────────────────────────────

  let wait = 250, since = null, watch = 0;

  function connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
    const lost = () => {
      socket.onclose = null;
      clearTimeout(watch);
      since = since || new Date();
      byId("link").textContent = "not connected";
      byId("offline").textContent = `No connection to the page's node since ${since.toLocaleTimeString()}. What is shown is old, and no button works, STOP neither: use the robot's own.`;
      byId("offline").hidden = false;
      document.body.classList.add("offline");
      setTimeout(connect, wait);
      wait = Math.min(2 * wait, 4000);
    };
    const alive = () => { // the node says something every few seconds, or the connection is gone
      clearTimeout(watch);
      watch = setTimeout(() => socket.close(), 12000);
    };
    socket.onopen = alive;
    socket.onclose = lost;
    socket.onmessage = (event) => {
      alive();
      [wait, since] = [250, null];
      document.body.classList.remove("offline");
      byId("offline").hidden = true;
      byId("link").textContent = "live";
      const sections = JSON.parse(event.data);
      Object.assign(data, sections);
      for (const [name, value] of Object.entries(sections)) if (SHOW[name]) SHOW[name](value);
    };
  }
  connect();
})();
