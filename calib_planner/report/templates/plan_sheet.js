"use strict";
// Remembers ticks and notes in this browser, by the identity of the plan, and gives them back as CSV.
(function () {
  const sheet = document.body.dataset, key = "calib_planner sheet " + sheet.identity;
  const fields = Array.from(document.querySelectorAll("[data-field]"));
  const rows = Array.from(document.querySelectorAll("tr[data-visit]"));
  const told = document.getElementById("told"), count = document.getElementById("count");
  let state = {};

  function remember() {
    try {
      localStorage.setItem(key, JSON.stringify(state));
      told.textContent = "Ticks and notes are kept in this browser.";
    } catch (error) {
      told.textContent = "This browser keeps nothing: save the CSV before you close the page.";
    }
  }

  function show() {
    let done = 0, all = 0;
    for (const row of rows) {
      const boxes = Array.from(row.querySelectorAll("input[type=checkbox]"));
      const ticked = boxes.filter((box) => box.checked).length, times = Number(row.dataset.repetitions);
      row.classList.toggle("done", ticked === boxes.length);
      done += boxes.length === times ? ticked : ticked * times;
      all += times;
    }
    count.textContent = `${done} of ${all} measured`;
  }

  function change(event) {
    const field = event.target, name = field.dataset.field;
    if (!name) return;
    if (field.type === "checkbox") {
      if (field.checked) state[name] = new Date().toISOString();
      else delete state[name];
    } else if (field.value) state[name] = field.value;
    else delete state[name];
    remember();
    show();
  }

  function fill() {
    for (const field of fields) {
      const value = state[field.dataset.field];
      if (field.type === "checkbox") field.checked = typeof value === "string";
      else field.value = typeof value === "string" ? value : "";
    }
    show();
  }

  const cell = (text) => (/[",\n\r]/.test(text) ? `"${text.replace(/"/g, '""')}"` : text);

  function csv() {
    const blanks = fields.filter((field) => field.dataset.blank);
    const head = ["plan", "visit", "configuration_index", "measurement", "measured", "measured_at", "note",
      ...blanks.map((field) => field.dataset.blank)];
    const lines = [head];
    for (const row of rows) {
      const note = row.querySelector("textarea").value;
      Array.from(row.querySelectorAll("input[type=checkbox]")).forEach((box, k) => {
        const at = state[box.dataset.field] || "";
        lines.push([sheet.identity, row.dataset.visit, String(row.dataset.visit - 1), String(k + 1), box.checked ? "yes" : "no", at, note,
          ...blanks.map((field) => field.value)]);
      });
    }
    return lines.map((line) => line.map(cell).join(",")).join("\n") + "\n";
  }

  function save() {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([csv()], { type: "text/csv" }));
    link.download = `measured_${sheet.identity}.csv`;
    link.click();
    URL.revokeObjectURL(link.href);
  }

  function clear() {
    if (!confirm("Forget all ticks and notes of this plan?")) return;
    state = {};
    fill();
    remember();
  }

  try {
    const kept = JSON.parse(localStorage.getItem(key) || "{}");
    if (kept && typeof kept === "object") state = kept;
    told.textContent = "Ticks and notes are kept in this browser.";
  } catch (error) {
    told.textContent = "This browser keeps nothing: save the CSV before you close the page.";
  }
  document.addEventListener("input", change);
  document.getElementById("save").addEventListener("click", save);
  document.getElementById("clear").addEventListener("click", clear);
  document.querySelector(".tools").hidden = false;
  window.sheetCsv = csv;
  fill();
})();
