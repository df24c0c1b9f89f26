// Tables are sorted by their headings and filtered; what a method or a column is stands beside it; folded sections open
// where a link or the printer leads into them.
const tip = document.createElement("div");
tip.className = "tip";
tip.hidden = true;
document.body.append(tip);
function showTip(text, x, y) {
  tip.textContent = text;
  tip.hidden = false;
  const box = tip.getBoundingClientRect(), right = document.documentElement.clientWidth - 8;
  tip.style.left = Math.max(8, Math.min(x + 14, right - box.width)) + "px";
  tip.style.top = (y + 18 + box.height > innerHeight ? Math.max(8, y - box.height - 10) : y + 18) + "px";
}
function hideTip() { tip.hidden = true; }
addEventListener("scroll", hideTip, {passive: true});
addEventListener("keydown", function (event) { if (event.key === "Escape") hideTip(); });

const cellText = cell => (cell.firstElementChild && cell.firstElementChild.tagName === "A" ? cell.firstElementChild
  : cell.firstChild || cell).textContent.replace(/[\s\u2009]+/g, " ").trim();
const asNumber = text => parseFloat(text.replace(/(\d) (?=\d)/g, "$1").replace("\u2212", "-").replace(/^[<>\u2265]/, ""));
function sort(table, place, falls) {
  for (const body of table.tBodies) {
    const rows = Array.from(body.rows).filter(row => row.cells.length > 1 || !row.cells[0].matches(".group"));
    const keyed = rows.map(row => [row.cells[place] ? cellText(row.cells[place]) : "", row]);
    const isNumber = place > 0 && 2 * keyed.filter(([text]) => !Number.isNaN(asNumber(text))).length >= keyed.length / 2;
    const missing = text => isNumber ? Number.isNaN(asNumber(text)) : text === "" || text === "\u2013";
    keyed.sort(function ([a], [b]) {
      if (missing(a) || missing(b)) return missing(a) - missing(b);
      const order = isNumber ? asNumber(a) - asNumber(b) : a.localeCompare(b);
      return falls ? -order : order;
    });
    body.append(...keyed.map(([, row]) => row));
  }
}
function describe(element, id) {
  const dt = document.getElementById(id);
  if (!dt) return;
  const meanings = [];
  for (let dd = dt.nextElementSibling; dd && dd.tagName === "DD"; dd = dd.nextElementSibling) {
    meanings.push(Array.from(dd.childNodes, node => node.textContent).join(" "));
    if (!dd.id) dd.id = id + "-" + meanings.length;
  }
  element.setAttribute("aria-describedby", id + "-1");
  function show() {
    const box = element.getBoundingClientRect();
    showTip(meanings.join("\n"), box.left, box.bottom - 10);
  }
  for (const name of ["pointerenter", "focus"]) element.addEventListener(name, show);
  for (const name of ["pointerleave", "blur"]) element.addEventListener(name, hideTip);
}
for (const table of document.querySelectorAll(".scroll table")) {
  const headings = Array.from(table.tHead.rows[0].cells);
  headings.forEach(function (heading, place) {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", function () {
      const isFalling = heading.getAttribute("aria-sort") !== "descending";
      headings.forEach(other => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", isFalling ? "descending" : "ascending");
      sort(table, place, isFalling);
    });
    if (heading.dataset.term) describe(button, heading.dataset.term);
  });
  if (table.rows.length > 10) {
    const field = document.createElement("input");
    field.type = "search";
    field.className = "filter";
    field.placeholder = "Filter rows";
    field.setAttribute("aria-label", "Filter the rows of: " + (table.caption ? table.caption.textContent : "this table"));
    field.addEventListener("input", function () {
      const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
      for (const body of table.tBodies) {
        let group = "";
        for (const row of body.rows) {
          if (row.cells.length === 1 && row.cells[0].matches(".group")) { group = row.textContent; continue; }
          const text = (group + " " + row.textContent).toLowerCase();
          row.hidden = !words.every(word => text.includes(word));
        }
      }
    });
    table.parentElement.before(field);
  }
}
for (const link of document.querySelectorAll(".scroll td > a[href^='#']")) describe(link, link.hash.slice(1));
function reveal() {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  for (let each = target; each; each = each.parentElement) if (each.tagName === "DETAILS") each.open = true;
  if (target) target.scrollIntoView();
}
addEventListener("hashchange", reveal);
// a link to where one is already changes no address
document.addEventListener("click", function (event) {
  const link = event.target.closest && event.target.closest("a[href^='#']");
  if (link && link.hash === location.hash) reveal();
});
reveal();
const folded = Array.from(document.querySelectorAll("details"));
let closed = [];
addEventListener("beforeprint", function () {
  closed = folded.filter(each => !each.open);
  closed.forEach(each => { each.open = true; });
});
addEventListener("afterprint", function () { closed.forEach(each => { each.open = false; }); });
const all = document.getElementById("open-all");
if (all) {
  all.hidden = false;
  all.addEventListener("click", function () {
    const sections = folded.filter(each => each.matches(".section")), isAllOpen = sections.every(each => each.open);
    sections.forEach(each => { each.open = !isAllOpen; });
    all.textContent = isAllOpen ? "Open all sections" : "Fold all sections";
  });
}
