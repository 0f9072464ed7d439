// Sorts a table by the column whose heading was clicked: numbers by their exact value, names as words.
(function () {
  "use strict";

  function key(cell) {
    const exact = cell.querySelector("data");
    const text = exact ? exact.value : cell.dataset.sort !== undefined ? cell.dataset.sort : cell.textContent;
    const number = text === "" ? NaN : Number(text);
    return { text: text, number: number };
  }

  function compare(a, b) {
    const numbers = [a, b].map((k) => Number.isFinite(k.number));
    if (numbers[0] && numbers[1]) return a.number - b.number;
    if (numbers[0] !== numbers[1]) return numbers[0] ? -1 : 1;
    return a.text.localeCompare(b.text);
  }

  function sort(table, column, heading) {
    const down = heading.getAttribute("aria-sort") === "ascending";
    for (const other of table.tHead.rows[0].cells) if (other.hasAttribute("aria-sort")) other.setAttribute("aria-sort", "none");
    heading.setAttribute("aria-sort", down ? "descending" : "ascending");
    const body = table.tBodies[0];
    const rows = Array.from(body.rows, (row, i) => ({ row: row, key: key(row.cells[column]), order: i }));
    rows.sort((a, b) => (down ? -1 : 1) * compare(a.key, b.key) || a.order - b.order);
    for (const item of rows) body.appendChild(item.row);
  }

  for (const table of document.querySelectorAll("table.sortable")) {
    Array.from(table.tHead.rows[0].cells).forEach((heading, column) => {
      if (heading.classList.contains("words")) return; // remarks have no order
      heading.tabIndex = 0;
      heading.setAttribute("aria-sort", "none");
      heading.addEventListener("click", () => sort(table, column, heading));
      heading.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        sort(table, column, heading);
      });
    });
  }
})();
