// A name of a legend pressed hides its series in this chart, pressed twice shows it alone; hovered or focused, it stands
// out. Beside the pointer the nearest point is told. Texts are set as text, never as markup.
function points(group) {
  if (group.points) return group.points;
  const told = group.querySelector("[data-p]"), found = [];
  if (told) {
    told.dataset.p.split(";").forEach(function (pair) { found.push(pair === "-" ? null : pair.split(",").map(Number)); });
  } else {
    let x = 0, y = 0;
    const d = group.querySelector(".line").getAttribute("d");
    for (const [, letter, first, second] of d.matchAll(/([MLHV])([-\d.]+)(?: ([-\d.]+))?/g)) {
      if (letter === "H") { x = Number(first); continue; }
      if (letter === "V") y = Number(first); else { x = Number(first); y = Number(second); }
      found.push([x, y]);
    }
  }
  return group.points = found;
}
function value(told, share) {
  const [start, end, isLog] = told.split(" ").map(Number);
  return isLog ? Math.pow(10, Math.log10(start) + share * Math.log10(end / start)) : start + share * (end - start);
}
function written(number, format) {
  const digits = Number(format.slice(1, -1));
  return format.endsWith("f") ? number.toFixed(digits) : String(Number(number.toPrecision(digits)));
}
function told(group, place, plot, names) {
  const width = plot.width.baseVal.value, height = plot.height.baseVal.value, [x, y] = points(group)[place];
  const at = {x: value(plot.dataset.x, x / width), y: value(plot.dataset.y, 1 - y / height)};
  const name = "s" in group.dataset ? names[group.dataset.s] : "";
  if (group.dataset.t) {
    const text = JSON.parse(group.dataset.t)[place] || "";
    return text.startsWith(name + ":") ? text : name + "\n" + text;
  }
  return name + "\n" + group.dataset.h.replace(/\{([xy])(:\.\d+[fg])\}/g, function (_, axis, format) {
    return written(at[axis], format.slice(1));
  });
}
for (const chart of document.querySelectorAll("figure.chart")) {
  const buttons = Array.from(chart.querySelectorAll(".legend button")), names = buttons.map(b => b.textContent);
  const groups = Array.from(chart.querySelectorAll("g[data-s]"));
  buttons.forEach(button => { button.type = "button"; button.setAttribute("aria-pressed", "true"); });
  const isOn = place => buttons[place].getAttribute("aria-pressed") === "true";
  function update(shown) {
    buttons.forEach(function (button, place) { button.setAttribute("aria-pressed", String(shown(place))); });
    groups.forEach(function (group) { group.classList.toggle("off", !isOn(group.dataset.s)); });
  }
  function raise(place) {
    chart.classList.toggle("raised", place !== null);
    groups.forEach(function (group) { group.classList.toggle("lit", Number(group.dataset.s) === place); });
  }
  buttons.forEach(function (button, place) {
    button.addEventListener("click", function () { update(other => other === place ? !isOn(other) : isOn(other)); });
    button.addEventListener("dblclick", function () {
      const isAlone = buttons.every((_, other) => isOn(other) === (other === place));
      update(other => isAlone || other === place);
    });
    for (const name of ["pointerenter", "focus"]) button.addEventListener(name, function () { raise(place); });
    for (const name of ["pointerleave", "blur"]) button.addEventListener(name, function () { raise(null); });
  });
  for (const plot of chart.querySelectorAll(".plot")) {
    plot.addEventListener("pointermove", function (event) {
      const box = plot.querySelector(".back").getBoundingClientRect();
      const scale = plot.width.baseVal.value / box.width;
      const x = (event.clientX - box.left) * scale, y = (event.clientY - box.top) * scale;
      let best = null, least = 30;
      for (const group of plot.querySelectorAll("g[data-h], g[data-t]")) {
        if (group.classList.contains("off")) continue;
        points(group).forEach(function (point, place) {
          const far = point ? Math.hypot(point[0] - x, point[1] - y) : Infinity;
          if (far < least) { least = far; best = [group, place]; }
        });
      }
      if (best) showTip(told(best[0], best[1], plot, names), event.clientX, event.clientY);
      else hideTip();
    });
    plot.addEventListener("pointerleave", hideTip);
  }
}
