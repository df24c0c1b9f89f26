// Sorts a table by the column whose heading is pressed: falling first where the cells are numbers. Empty cells stay last.
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const heading = button.parentElement, table = heading.closest("table"), body = table.tBodies[0];
    const place = heading.cellIndex, rows = [...body.rows], key = row => row.cells[place].dataset.key;
    const isNumber = rows.every(row => key(row) === "" || !Number.isNaN(Number(key(row))));
    const was = heading.getAttribute("aria-sort");
    const falls = was ? was === "ascending" : isNumber;
    const order = (a, b) => isNumber ? Number(a) - Number(b) : a.localeCompare(b);
    rows.sort((a, b) => {
      const [x, y] = [key(a), key(b)];
      if (x === "" || y === "") return (x === "") - (y === "");
      return falls ? order(y, x) : order(x, y);
    });
    for (const other of heading.parentElement.cells) other.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", falls ? "descending" : "ascending");
    body.append(...rows);
  });
}
