// Loss terms over training steps, on a logarithmic axis.

const LOSS_COLOURS = ["--body-0", "--body-1", "--body-2", "--body-3", "--goal", "--belief", "--soft"];

function drawLossChart(parent, losses, colour, width) {
  parent.replaceChildren();
  const box = { left: 56, right: width - 10, top: 8, bottom: 8 + Math.min(300, 0.5 * width + 60) };
  const positive = losses.flatMap((loss) => [...loss.value]).filter((value) => value > 0 && Number.isFinite(value));
  const steps = losses.flatMap((loss) => [...loss.step]).filter(Number.isFinite);
  if (!positive.length || !steps.length) return;
  const extent = (values) => values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
  const [low, high] = extent(positive);
  const domain = [low / 1.3, high * 1.3];
  const names = [...new Set(losses.map((loss) => loss.name))].join(", ");
  const label = `Loss terms over training steps: ${names}`;
  const svg = element("svg", { class: "plot", viewBox: `0 0 ${width} ${box.bottom + 38}`, role: "img", "aria-label": label }, parent);
  const stepDomain = extent(steps);
  const toX = linearScale(stepDomain, [box.left, box.right]);
  const toY = logScale(domain, [box.bottom, box.top]);
  for (const tick of logTicks(...domain)) {
    element("line", { class: "grid", x1: box.left, x2: box.right, y1: toY(tick), y2: toY(tick) }, svg);
    element("text", { x: box.left - 8, y: toY(tick) + 4, "text-anchor": "end" }, svg, readable(tick));
  }
  for (const tick of niceTicks(...stepDomain, width > 600 ? 6 : 3)) {
    element("text", { x: toX(tick), y: box.bottom + 17, "text-anchor": "middle" }, svg, tick.toLocaleString("en"));
  }
  element("text", { x: (box.left + box.right) / 2, y: box.bottom + 34, "text-anchor": "middle" }, svg, "training step");
  for (const loss of losses) {
    const points = [...loss.step].map((step, place) => [toX(step), loss.value[place] > 0 ? toY(loss.value[place]) : NaN]);
    const style = { class: loss.heldOut ? "line dashed" : "line", stroke: `var(${colour(loss.name)})` };
    element("path", { ...style, d: linePath(points) }, svg);
  }
}

function startLossChart() {
  const parent = document.getElementById("loss-chart");
  if (!parent) return;
  const names = [...new Set(payload.losses.map((loss) => loss.name))];
  const colour = (name) => LOSS_COLOURS[names.indexOf(name) % LOSS_COLOURS.length];
  const legend = document.getElementById("loss-legend");
  for (const name of names) {
    legendEntry(legend, name, (svg) =>
      element("line", { x1: 1, y1: 6, x2: 21, y2: 6, stroke: `var(${colour(name)})`, "stroke-width": 2 }, svg));
  }
  if (payload.losses.some((loss) => loss.heldOut)) {
    legendEntry(legend, "held out", (svg) =>
      element("line", { x1: 1, y1: 6, x2: 21, y2: 6, stroke: "var(--soft)", "stroke-width": 2, "stroke-dasharray": "4 3" }, svg));
  }
  redrawOnResize(parent, (width) => drawLossChart(parent, payload.losses, colour, width));
}
