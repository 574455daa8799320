// Beliefs about one edge over time, by what has corrected them, above strips of its likeliest type.

const BELIEF_STYLES = [
  { colour: "--body-0", "stroke-width": 5, "stroke-opacity": 0.35 },
  { colour: "--body-1", "stroke-width": 1.8 },
  { colour: "--body-3", "stroke-width": 1.5, "stroke-dasharray": "4 2.5" },
];
const STATE_FILLS = { free: "--bone", touch: "--body-2", hold: "--contact-ink", contact: "--contact-ink" };
const STRIP = { height: 13, gap: 6 };

function beliefStyle(lines, place) {
  // Without evidence by motion there are two lines, of which the last is still that of nothing.
  const { colour, ...rest } = BELIEF_STYLES[place === lines.length - 1 ? 2 : place];
  return { ...rest, stroke: `var(${colour})` };
}

// A value over each step, which leads from state `step` to the one after.
function stepLine(values, toX, toY) {
  return linePath([...values].flatMap((value, step) => [[toX(step), toY(value)], [toX(step + 1), toY(value)]]));
}

function drawStrip(svg, name, runs, toX, left, y) {
  element("text", { class: name === "truth" ? "strong" : "", x: left - 8, y: y + STRIP.height - 2.5, "text-anchor": "end" }, svg, name);
  for (const [state, first, end] of runs) {
    const [x, height] = [toX(first), state === "free" ? 3 : STRIP.height];
    const fill = `var(${STATE_FILLS[state]})`;
    element("rect", { x, y: y + (STRIP.height - height) / 2, width: toX(end) - x, height, fill }, svg);
  }
}

function drawBeliefTimeline(parent, timeline, width) {
  parent.replaceChildren();
  html("h3", {}, parent, timeline.title);
  const { lines, truth, label, dt } = timeline;
  const steps = lines[0].belief.length;
  const [left, right, top, height] = [130, width - 8, 8, 96];
  const strips = top + height + 14;
  const bottom = strips + (lines.length + 1) * (STRIP.height + STRIP.gap);
  const svg = element("svg", { class: "plot", viewBox: `0 0 ${width} ${bottom + 20}`, role: "img", "aria-label": timeline.caption }, parent);
  const toX = linearScale([0, steps], [left, right]);
  const toY = linearScale([0, 1], [top + height, top]);
  for (const [state, first, end] of truth) {
    if (state !== label) continue;
    element("rect", { class: "band", x: toX(first), width: toX(end) - toX(first), y: top, height }, svg);
  }
  for (const tick of [0, 0.5, 1]) {
    element("line", { class: "grid", x1: left, x2: right, y1: toY(tick), y2: toY(tick) }, svg);
    element("text", { x: left - 8, y: toY(tick) + 4, "text-anchor": "end" }, svg, readable(tick));
  }
  element("text", { class: "strong", x: 0, y: toY(0.5) + 4 }, svg, `belief in ${label}`);
  lines.forEach(({ belief }, place) => {
    element("path", { class: "line", ...beliefStyle(lines, place), d: stepLine(belief, toX, toY) }, svg);
  });
  const rows = [{ source: "truth", states: truth }, ...lines];
  rows.forEach(({ source, states }, row) => {
    drawStrip(svg, source, states, toX, left, strips + row * (STRIP.height + STRIP.gap));
  });
  for (const tick of niceTicks(0, steps * dt, width > 420 ? 6 : 3)) {
    const x = toX(tick / dt);
    element("line", { class: "axis", x1: x, x2: x, y1: bottom - 2, y2: bottom + 2 }, svg);
    element("text", { x, y: bottom + 15, "text-anchor": "middle" }, svg, `${readable(tick)} s`);
  }
  html("p", { class: "caption" }, parent, timeline.caption);
}

function startBeliefChart() {
  const parent = document.getElementById("belief-charts");
  if (!parent) return;
  const legend = document.getElementById("belief-legend");
  const longest = payload.beliefs.reduce((most, each) => (each.lines.length > most.lines.length ? each : most));
  longest.lines.forEach(({ source }, place) => legendEntry(legend, `corrected by ${source}`, (svg) =>
    element("line", { x1: 0, x2: 22, y1: 6, y2: 6, ...beliefStyle(longest.lines, place) }, svg)));
  legendEntry(legend, "true", (svg) => element("rect", { width: 22, height: 12, fill: "var(--contact)", "fill-opacity": 0.5 }, svg));
  const shown = new Set(payload.beliefs.flatMap(({ truth, lines }) =>
    [truth, ...lines.map(({ states }) => states)].flat().map(([state]) => state)));
  const named = Object.entries(STATE_FILLS).filter(([state]) => shown.has(state));
  for (const colour of new Set(named.map(([, fill]) => fill))) {
    const names = named.filter(([, fill]) => fill === colour).map(([state]) => state);
    const height = names.includes("free") ? 3 : 12;
    legendEntry(legend, names.join(", "), (svg) => element("rect", { y: (12 - height) / 2, width: 22, height, fill: `var(${colour})` }, svg));
  }
  for (const timeline of payload.beliefs) {
    const panel = html("div", {}, parent);
    redrawOnResize(panel, (width) => drawBeliefTimeline(panel, timeline, width));
  }
}
