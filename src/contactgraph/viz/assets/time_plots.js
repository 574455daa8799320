// Plots over time that share one cursor with the scene. A panel is
// { title, unit, height, domain, ticks, spans, lines: [{ name, colour, dash, perStep, read(index) }] },
// where `perStep` lines hold a value over each step and the others join the states.

const MARGIN = { left: 38, right: 6, top: 5, bottom: 5 };
const cursors = [];

function shownSpan() {
  return clock.span ?? [0, clock.scene.steps];
}

function linePoints(line, toX, toY, [first, last]) {
  const points = [];
  for (let index = Math.floor(first); index <= last; index += 1) {
    const value = line.read(index);
    if (!line.perStep) points.push([toX(index), toY(value)]);
    else if (index < last) points.push([toX(index), toY(value)], [toX(index + 1), toY(value)]);
  }
  return points;
}

function valueTicks({ domain, height }) {
  const ticks = niceTicks(...domain, height > 90 ? 4 : 2);
  return ticks.length > 1 ? ticks : niceTicks(...domain, 4);
}

function drawAxes(svg, panel, toX, toY, width, bottom) {
  for (const tick of panel.ticks ?? valueTicks(panel)) {
    element("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: toY(tick), y2: toY(tick) }, svg);
    element("text", { x: MARGIN.left - 6, y: toY(tick) + 4, "text-anchor": "end" }, svg, readable(tick));
  }
  if (!panel.timeAxis) return;
  const { dt } = clock.scene;
  const [first, last] = shownSpan();
  for (const tick of niceTicks(first * dt, last * dt, width > 420 ? 6 : 4)) {
    const x = toX(tick / dt);
    element("line", { class: "axis", x1: x, x2: x, y1: bottom, y2: bottom + 4 }, svg);
    element("text", { x, y: bottom + 16, "text-anchor": "middle" }, svg, `${readable(tick)} s`);
  }
}

function drawPanel(parent, panel, width) {
  const bottom = MARGIN.top + panel.height;
  const total = bottom + (panel.timeAxis ? 20 : MARGIN.bottom);
  const words = `${panel.title} over time${panel.unit ? `, ${panel.unit}` : ""}`;
  const svg = element("svg", { class: "plot time-plot", viewBox: `0 0 ${width} ${total}`, role: "img", "aria-label": words }, parent);
  const span = shownSpan();
  const toX = linearScale(span, [MARGIN.left, width - MARGIN.right]);
  const toY = linearScale(panel.domain, [bottom, MARGIN.top]);
  for (const [first, end] of panel.spans ?? []) {
    const [from, to] = [Math.max(first - 1, span[0]), Math.min(end - 1, span[1])];
    if (to <= from) continue;
    element("rect", { class: "band", x: toX(from), width: toX(to) - toX(from), y: MARGIN.top, height: panel.height }, svg);
  }
  drawAxes(svg, panel, toX, toY, width, bottom);
  for (const line of panel.lines) {
    const style = { class: `line ${line.dash ?? "solid"}`, stroke: `var(${line.colour})` };
    element("path", { ...style, d: linePath(linePoints(line, toX, toY, span)) }, svg);
  }
  const cursor = element("line", { class: "cursor", y1: MARGIN.top - 2, y2: bottom + 2 }, svg);
  cursors.push(() => {
    const x = toX(Math.max(span[0], Math.min(span[1], clock.step)));
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
  });
  followPointer(svg, (fraction) => seek(span[0] + fraction * (span[1] - span[0])), width);
}

// Moving over a plot moves through time; what was playing goes on when the pointer leaves.
function followPointer(svg, goTo, width) {
  let wasPlaying = false;
  const move = (event) => {
    const box = svg.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * width;
    goTo(Math.max(0, Math.min(1, (x - MARGIN.left) / (width - MARGIN.left - MARGIN.right))));
  };
  svg.addEventListener("pointerenter", () => {
    wasPlaying = clock.playing;
    if (wasPlaying) pause();
  });
  svg.addEventListener("pointermove", move);
  svg.addEventListener("pointerdown", move);
  svg.addEventListener("pointerleave", () => {
    if (wasPlaying) play();
    wasPlaying = false;
  });
}

// The panel's name, and each line's value under the cursor, which serves as its legend.
function writePanelHead(parent, panel) {
  const head = html("div", { class: "panel-head" }, parent);
  const title = html("span", {}, head, panel.title);
  if (panel.unit) html("span", { class: "unit" }, title, `  ${panel.unit}`);
  const values = html("span", { class: "values" }, head);
  for (const line of panel.lines) {
    const value = html("span", { style: `color: var(${line.colour})` }, values);
    cursors.push(() => {
      const index = line.perStep ? stepOf(clock.scene, clock.step) : Math.round(clock.step);
      const number = line.read(index);
      const text = Number.isFinite(number) ? number.toFixed(2) : "–";
      value.textContent = line.name ? `${line.name} ${text}` : text;
    });
  }
}

function drawGroup(id, panels) {
  const group = document.getElementById(id);
  for (const old of group.querySelectorAll(".panel")) old.remove();
  group.hidden = panels.length === 0;
  panels.forEach((panel, place) => {
    panel.timeAxis = place === panels.length - 1;
    const parent = html("div", { class: "panel" }, group);
    writePanelHead(parent, panel);
    drawPanel(parent, panel, Math.max(200, Math.floor(parent.clientWidth)));
  });
}
