(function () {
  "use strict";
  const PRINT_PX = 900;
  const charts = Array.from(document.querySelectorAll(".chart"));
  const config = {
    responsive: true, displaylogo: false, displayModeBar: "hover",
    modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]],
  };
  function draw(place) {
    if (place.dataset.drawn) return;
    place.dataset.drawn = "yes";
    const figure = JSON.parse(document.getElementById("data-" + place.id).textContent);
    Plotly.newPlot(place, figure.data, figure.layout, config);
  }
  // once the page is there, one after the other, so that it can be read and scrolled from the start
  let next = 0;
  function step() {
    if (next < charts.length) {
      draw(charts[next++]);
      setTimeout(step, 0);
    }
  }
  addEventListener("load", function () { setTimeout(step, 0); });
  // paper is narrower than the screen by an amount that no script is told: drawn at one width, scaled by the style
  addEventListener("beforeprint", function () {
    charts.forEach(function (place) {
      draw(place);
      Plotly.relayout(place, {autosize: false, width: PRINT_PX});
      place.querySelectorAll(".main-svg").forEach(function (svg) {
        svg.setAttribute("viewBox", [0, 0, PRINT_PX, place._fullLayout.height].join(" "));
      });
    });
  });
  addEventListener("afterprint", function () {
    charts.forEach(function (place) {
      place.querySelectorAll(".main-svg").forEach(function (svg) { svg.removeAttribute("viewBox"); });
      Plotly.relayout(place, {autosize: true, width: null});
    });
  });
})();
