// N-step errors as points on a logarithmic axis: a bar has no honest foot there.

const PREDICTORS = [
  { key: "standingStill", name: "standing still", shape: "diamond" },
  { key: "constantVelocity", name: "constant velocity", shape: "square" },
  { key: "frozenContact", name: "frozen contact", shape: "ring" },
  { key: "model", name: "this model", shape: "dot" },
];

function predictorMark(svg, shape, x, y) {
  const quiet = { fill: "var(--page)", stroke: "var(--soft)", "stroke-width": 1.6 };
  if (shape === "square") return element("rect", { x: x - 4, y: y - 4, width: 8, height: 8, ...quiet }, svg);
  if (shape === "diamond") return element("path", { d: `M ${x - 5} ${y} L ${x} ${y - 5} L ${x + 5} ${y} L ${x} ${y + 5} Z`, ...quiet }, svg);
  if (shape === "ring") return element("circle", { cx: x, cy: y, r: 4.5, ...quiet }, svg);
  return element("circle", { cx: x, cy: y, r: 5.5, fill: "var(--body-0)" }, svg);
}

function errorDomain(errors) {
  const values = errors
    .flatMap((error) => [...PREDICTORS.map(({ key }) => error[key]), ...(error.interval ?? [])])
    .filter((value) => value > 0)
    .map((value) => 100 * value);
  if (!values.length) return [0.1, 10];
  return [Math.min(...values) / 1.6, Math.max(...values) * 1.6];
}

function drawErrorRow(svg, error, y, toX) {
  const present = PREDICTORS.filter(({ key }) => error[key] > 0);
  const places = present.map(({ key }) => toX(100 * error[key]));
  if (places.length > 1) {
    element("line", { class: "axis", x1: Math.min(...places), x2: Math.max(...places), y1: y, y2: y }, svg);
  }
  if (error.interval && error.interval.every((value) => value > 0)) {
    const [low, high] = error.interval.map((value) => toX(100 * value));
    element("line", { x1: low, x2: high, y1: y, y2: y, stroke: "var(--body-0)", "stroke-width": 3, "stroke-opacity": 0.4 }, svg);
  }
  present.forEach(({ key, name, shape }, place) => {
    const mark = predictorMark(svg, shape, places[place], y);
    element("title", {}, mark, `${name}: ${readable(100 * error[key])} cm`);
    const text = { x: places[place], y: y - 10, "text-anchor": "middle" };
    if (key === "model") element("text", { ...text, class: "strong", "font-weight": 600 }, svg, readable(100 * error[key], 2));
  });
}

function drawErrorPanel(parent, windows, errors, domain, width) {
  parent.replaceChildren();
  html("h3", {}, parent, windows);
  const longest = Math.max(...errors.map((error) => error.condition.length));
  const left = Math.min(0.4 * width, 12 + 6.4 * longest);
  const rowHeight = 38;
  const bottom = 8 + rowHeight * errors.length;
  const said = errors.map((error) => `${error.condition}: ${readable(error.model && 100 * error.model)}`).join("; ");
  const label = `N-step error in cm, ${windows}. ${said}`;
  const svg = element("svg", { class: "plot", viewBox: `0 0 ${width} ${bottom + 36}`, role: "img", "aria-label": label }, parent);
  const toX = logScale(domain, [left, width - 10]);
  for (const tick of logTicks(...domain)) {
    element("line", { class: "grid", x1: toX(tick), x2: toX(tick), y1: 4, y2: bottom }, svg);
    element("text", { x: toX(tick), y: bottom + 15, "text-anchor": "middle" }, svg, readable(tick));
  }
  element("text", { x: (left + width - 10) / 2, y: bottom + 31, "text-anchor": "middle" }, svg, "cm");
  errors.forEach((error, row) => {
    const y = 8 + rowHeight * (row + 0.6);
    element("text", { class: "strong", x: 0, y: y + 4 }, svg, error.condition);
    drawErrorRow(svg, error, y, toX);
  });
}

function startErrorChart() {
  const parent = document.getElementById("error-charts");
  if (!parent) return;
  if (payload.horizon !== null) {
    document.getElementById("horizon").textContent = `, ${readable(payload.horizon)} s ahead`;
  }
  const legend = document.getElementById("error-legend");
  for (const { name, shape } of [...PREDICTORS].reverse()) {
    legendEntry(legend, name, (svg) => predictorMark(svg, shape, 11, 6));
  }
  const domain = errorDomain(payload.errors);
  for (const windows of new Set(payload.errors.map((error) => error.windows))) {
    const panel = html("div", {}, parent);
    const errors = payload.errors.filter((error) => error.windows === windows);
    redrawOnResize(panel, (width) => drawErrorPanel(panel, windows, errors, domain, width));
  }
}
