// Reliability of beliefs: share of active edges over believed probability, one panel a horizon.

const RELIABILITY_COLOURS = ["--body-0", "--body-1", "--body-3", "--body-2"];
const LARGEST_POINT = 7;

function drawReliabilityPanel(parent, panel, curves, colour, width) {
  parent.replaceChildren();
  html("h3", {}, parent, panel);
  const size = Math.min(width - 60, 280);
  const box = { left: 46, right: 46 + size, top: 8, bottom: 8 + size };
  const said = curves.map((curve) => `${curve.source}: calibration error ${readable(curve.error, 2)}`).join("; ");
  const label = `Share of active edges over belief, ${panel}. ${said}`;
  const svg = element("svg", { class: "plot", viewBox: `0 0 ${width} ${box.bottom + 38}`, role: "img", "aria-label": label }, parent);
  const toX = linearScale([0, 1], [box.left, box.right]);
  const toY = linearScale([0, 1], [box.bottom, box.top]);
  for (const tick of [0, 0.25, 0.5, 0.75, 1]) {
    element("line", { class: "grid", x1: box.left, x2: box.right, y1: toY(tick), y2: toY(tick) }, svg);
    element("text", { x: box.left - 8, y: toY(tick) + 4, "text-anchor": "end" }, svg, readable(tick));
    element("text", { x: toX(tick), y: box.bottom + 17, "text-anchor": "middle" }, svg, readable(tick));
  }
  element("line", { class: "dashed", stroke: "var(--faint)", x1: toX(0), y1: toY(0), x2: toX(1), y2: toY(1) }, svg);
  element("text", { x: (box.left + box.right) / 2, y: box.bottom + 34, "text-anchor": "middle" }, svg, "belief");
  element("text", { x: 0, y: 0, "text-anchor": "middle", transform: `translate(11 ${(box.top + box.bottom) / 2}) rotate(-90)` }, svg, "share active");
  for (const { source, bins } of curves) {
    const most = Math.max(...bins.map(([count]) => count));
    const points = bins.map(([, belief, share]) => [toX(belief), toY(share)]);
    element("path", { class: "line", stroke: `var(${colour(source)})`, d: linePath(points) }, svg);
    bins.forEach(([count, belief, share], place) => {
      const [cx, cy] = points[place];
      const r = Math.max(1.5, LARGEST_POINT * Math.sqrt(count / most));
      const point = element("circle", { cx, cy, r, fill: `var(${colour(source)})`, "fill-opacity": 0.75 }, svg);
      element("title", {}, point, `${source}: ${count} edges, belief ${readable(belief)}, active ${readable(share)}`);
    });
  }
}

function startReliabilityChart() {
  const parent = document.getElementById("reliability-charts");
  if (!parent) return;
  const sources = [...new Set(payload.reliability.map((curve) => curve.source))];
  const colour = (source) => RELIABILITY_COLOURS[sources.indexOf(source) % RELIABILITY_COLOURS.length];
  const legend = document.getElementById("reliability-legend");
  for (const source of sources) {
    legendEntry(legend, source, (svg) => element("circle", { cx: 11, cy: 6, r: 5, fill: `var(${colour(source)})` }, svg));
  }
  for (const name of new Set(payload.reliability.map((curve) => curve.panel))) {
    const panel = html("div", {}, parent);
    const curves = payload.reliability.filter((curve) => curve.panel === name);
    redrawOnResize(panel, (width) => drawReliabilityPanel(panel, name, curves, colour, width));
  }
}
