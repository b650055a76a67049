"use strict";
// Sorts a table by the column whose heading is pressed; again the other way round.
for (const table of document.querySelectorAll("table")) {
  const headings = table.querySelectorAll("thead th");
  headings.forEach((heading, column) => {
    heading.querySelector("button").addEventListener("click", () => {
      const down = heading.getAttribute("aria-sort") === "ascending";
      headings.forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = [...table.tBodies[0].rows];
      const key = (row) => row.cells[column].dataset.v;
      const compare = (a, b) => {
        const [x, y] = [key(a), key(b)];
        if (x === undefined || y === undefined) {
          return a.cells[column].textContent.localeCompare(b.cells[column].textContent, "en", { numeric: true });
        }
        if (x === "" || y === "") return (x === "") - (y === "") || 0;
        return down ? y - x : x - y;
      };
      rows.sort(compare);
      if (down && rows.some((row) => key(row) === undefined)) rows.reverse();
      table.tBodies[0].append(...rows);
    });
  });
}
// Light, dark, or as the system has it.
const themes = ["auto", "light", "dark"];
const toggle = document.getElementById("theme");
toggle.addEventListener("click", () => {
  const now = themes[(themes.indexOf(toggle.dataset.theme) + 1) % themes.length];
  toggle.dataset.theme = now;
  toggle.textContent = "Theme: " + now;
  document.documentElement.dataset.theme = now;
});
