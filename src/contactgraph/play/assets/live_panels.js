// The numbers beside the scene; they are written a few times a second.

const SHOWN_EDGES = 3;
const CALIBRATION = 250; // px, the width of the small chart
const panel = (id) => document.getElementById(id);

function writeTiles({ medianMs, distance, reached, episodes, successes, time }) {
  panel("median-ms").textContent = readable(medianMs ?? null, 2);
  panel("distance").textContent = distance === null || distance === undefined ? "–" : (100 * distance).toFixed(1);
  panel("distance").parentElement.classList.toggle("reached", Boolean(reached));
  panel("goal-name").textContent = reached ? "to the goal: reached" : "to the goal";
  panel("episodes").textContent = `${successes} of ${episodes}`;
  panel("now").textContent = `${(time ?? 0).toFixed(2)} s`;
}

// The edges along the task's chain, then those that are believed most.
function shownEdges(scene) {
  const last = (edge) => scene.belief[(HISTORY - 1) * scene.edges.length + edge];
  const inChain = ([i, j]) => scene.involved.some((node, place) => {
    const next = scene.involved[place + 1];
    return next !== undefined && Math.min(node, next) === i && Math.max(node, next) === j;
  });
  const rank = (edge) => (inChain(scene.edges[edge]) ? 2 : 0) + last(edge);
  const order = scene.edges.map((_, edge) => edge).sort((a, b) => rank(b) - rank(a));
  return order.filter((edge) => rank(edge) > 0.1).slice(0, SHOWN_EDGES);
}

// Steps in which an edge truly exists, as [first, last + 1].
function touchedSpans(scene, edge) {
  const spans = [];
  for (let step = 0; step < HISTORY; step += 1) {
    if (!scene.touched[step * scene.edges.length + edge]) continue;
    if (spans.length && spans.at(-1)[1] === step) spans.at(-1)[1] += 1;
    else spans.push([step, step + 1]);
  }
  return spans;
}

function drawBeliefs(scene) {
  const parent = panel("belief-plots");
  parent.replaceChildren();
  const width = parent.clientWidth;
  const count = scene.edges.length;
  const [left, right, top, height] = [28, width - 2, 8, 48];
  const toX = linearScale([0, HISTORY - 1], [left, right]);
  const toY = linearScale([0, 1], [top + height, top]);
  for (const edge of shownEdges(scene)) {
    const box = html("div", { class: "panel" }, parent);
    const head = html("div", { class: "panel-head" }, box);
    html("span", {}, head, scene.edgeName[edge]);
    const now = scene.belief[(HISTORY - 1) * count + edge];
    html("span", { class: "values ink-belief" }, head, now.toFixed(2));
    const label = `Belief in ${scene.edgeName[edge]}: ${now.toFixed(2)}`;
    const svg = element("svg", { class: "plot", viewBox: `0 0 ${width} ${top + height + 6}`, role: "img", "aria-label": label }, box);
    const steps = Array.from({ length: HISTORY }, (_, step) => step);
    for (const [from, until] of touchedSpans(scene, edge)) {
      const x = Math.max(left, toX(from - 0.5));
      element("rect", { class: "band", x, y: top, width: Math.min(right, toX(until - 0.5)) - x, height }, svg);
    }
    for (const tick of [0, 0.5, 1]) {
      element("line", { class: "grid", x1: left, x2: right, y1: toY(tick), y2: toY(tick) }, svg);
      element("text", { x: left - 6, y: toY(tick) + 4, "text-anchor": "end" }, svg, readable(tick));
    }
    const points = steps.map((step) => [toX(step), toY(scene.belief[step * count + edge])]);
    element("path", { class: "line", stroke: "var(--belief)", d: linePath(points) }, svg);
  }
}

function drawMasses(scene, rows) {
  const parent = panel("masses");
  parent.replaceChildren();
  if (!rows) {
    html("p", { class: "caption" }, parent, "This model has no such numbers.");
    return;
  }
  const known = scene.nodeName.map((_, node) => node).filter((node) => rows[0][node] !== null);
  const largest = Math.max(1, ...known.map((node) => rows[0][node]));
  for (const node of known.slice(0, 8)) {
    const row = html("div", { class: "mass" }, parent);
    html("span", {}, row, scene.nodeName[node]);
    const bar = html("i", {}, html("span", { class: "length" }, row));
    bar.style.width = `${Math.max(0, (100 * rows[0][node]) / largest)}%`;
    bar.style.background = `var(${colourName(scene, node)})`;
    html("span", {}, row, readable(Math.abs(rows[0][node]) < 5e-4 ? 0 : rows[0][node], 2));
  }
}

function drawReliability(curve) {
  const parent = panel("reliability");
  parent.parentElement.hidden = !curve;
  if (!curve) return;
  drawReliabilityPanel(parent, `How well calibrated: error ${curve.error.toFixed(3)}`, [curve], () => "--body-0", CALIBRATION);
  parent.querySelector("svg").style.maxWidth = `${CALIBRATION}px`;
}

let panelsDrawn = 0;
function drawPanels() {
  const { scene } = clock;
  const { frame } = live;
  if (!scene || !frame || frame.scene !== live.number) return;
  writeTiles(frame);
  if (frame.step !== undefined) {
    drawBeliefs(scene);
    drawMasses(scene, frame.inverseMass);
  }
  panelsDrawn += 1;
  if (panelsDrawn % 6 === 1) drawReliability(frame.reliability);
}
