// Sorts tables of class "sortable" by a click on a column's title, and shows only the rows that contain the words of the box above.
document.querySelectorAll("table.sortable").forEach(table => {
  const body = table.tBodies[0], rows = [...body.rows], titles = [...table.tHead.rows[0].cells];
  const text = cell => cell.firstChild ? cell.innerText.split("\n")[0].trim() : "";
  const value = cell => {
    const plain = text(cell).replace("\u2212", "-").replace(/[,\u00a0]/g, "").replace(/^< /, "");
    return /^[+-]?(\d|\.\d|\u221e)/.test(plain) ? (plain.includes("\u221e") ? Infinity : parseFloat(plain)) : null;
  };
  const sort = (k, sign) => {
    const keyed = rows.map((row, i) => [row, value(row.cells[k]), text(row.cells[k]), i]);
    keyed.sort(([, a, s, i], [, b, t, j]) => {
      if (a !== null && b !== null) return a === b ? i - j : sign * (a - b);
      if ((a === null) !== (b === null)) return a === null ? 1 : -1;  // numbers first, whatever the direction
      return sign * s.localeCompare(t) || i - j;
    });
    keyed.forEach(([row]) => body.append(row));
    titles.forEach((title, n) => title.setAttribute("aria-sort", n !== k ? "none" : sign > 0 ? "ascending" : "descending"));
  };
  titles.forEach((title, k) => {
    const button = document.createElement("button");
    button.append(...title.childNodes);
    title.append(button);
    button.addEventListener("click", () => sort(k, title.getAttribute("aria-sort") === "ascending" ? -1 : 1));
  });
  const words = document.createElement("input");
  words.type = "search";
  words.placeholder = "show only rows with ...";
  words.setAttribute("aria-label", "show only rows with these words");
  words.className = "filter";
  words.addEventListener("input", () => {
    const wanted = words.value.toLowerCase().split(/\s+/).filter(word => word);
    rows.forEach(row => { row.hidden = !wanted.every(word => row.textContent.toLowerCase().includes(word)); });
  });
  table.parentElement.before(words);
});
