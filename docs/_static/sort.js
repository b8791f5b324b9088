// Tables of which every row stands for itself are sorted by a click on a column's title (tablesort, MIT licence).
const first = text => text.replace("−", "-").replaceAll(",", "").match(/^[-+]?\d+(\.\d+)?/)?.[0];

addEventListener("load", () => {
  // The library's comparisons are the other way round
  const order = (a, b) => Number(first(b) ?? Infinity) - Number(first(a) ?? Infinity);
  Tablesort.extend("first number", text => first(text) !== undefined, order);
  for (const table of document.querySelectorAll("article table.docutils")) {
    const rows = [...table.tBodies[0]?.rows ?? []];
    if (!table.tHead || rows.length < 5 || rows.some(row => !row.cells[0].textContent.trim())) continue;
    [...table.tHead.rows[0].cells].forEach((title, k) => {
      const texts = rows.map(row => row.cells[k]?.textContent.trim() ?? "").filter(text => text && text !== "-");
      if (texts.length && texts.every(text => first(text) !== undefined)) title.dataset.sortMethod = "first number";
    });
    new Tablesort(table);
  }
});
