// Which panels a run has: beliefs, learned parameters, motion.

const DASHES = ["solid", "dashed", "dotted"]; // of the first, second and third axis

function beliefPanels(run) {
  const read = (edge) => (step) => run.belief[step * run.edges.length + edge];
  const panels = run.leading.map((edge) => ({
    title: run.edgeName[edge],
    height: 44,
    domain: [0, 1],
    ticks: [0, 0.5, 1],
    spans: run.contact ? run.contact[edge] : [],
    lines: [{ name: "", colour: "--belief", perStep: true, read: read(edge) }],
  }));
  const rest = run.edges.map((_, edge) => edge).filter((edge) => !run.leading.includes(edge));
  if (rest.length) {
    const largest = (step) => rest.reduce((most, edge) => Math.max(most, read(edge)(step) || 0), 0);
    panels.push({
      title: rest.length === 1 ? "the one other edge" : `all ${rest.length} other edges: largest belief`,
      height: 22,
      domain: [0, 1],
      ticks: [0, 1],
      lines: [{ name: "", colour: "--belief", perStep: true, read: largest }],
    });
  }
  return panels;
}

// From zero, or the least value, to the largest one; never an empty range.
function valueDomain(lines, count, withZero) {
  let [low, high] = withZero ? [0, 0] : [Infinity, -Infinity];
  for (const line of lines) {
    for (let index = 0; index < count; index += 1) {
      const value = line.read(index);
      if (!Number.isFinite(value)) continue;
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  if (!(low <= high)) return [0, 1];
  const margin = 0.06 * (high - low) || 0.5;
  return [withZero && low === 0 ? 0 : low - margin, high + margin];
}

function parameterPanels(run) {
  const spans = run.contact && run.leading.length ? run.contact[run.leading[0]] : [];
  const kinds = [
    { title: "inverse mass 1/m", unit: "1/kg", height: 110, values: run.inverseMass, least: 0.1 },
    { title: "stiffness k/m", unit: "1/s²", height: 52, values: run.stiffness, least: 0 },
    { title: "damping c/m", unit: "1/s", height: 52, values: run.damping, least: 0 },
  ];
  return kinds.filter((kind) => kind.values).map((kind) => {
    const lines = run.focus.flatMap((node) => kind.values.map((values, direction) => ({
      name: direction === 0 ? run.nodeName[node] : "",
      colour: colourName(run, node),
      dash: DASHES[direction],
      perStep: true,
      read: (step) => values[step * run.nodes + node],
    })));
    const [low, high] = valueDomain(lines, run.steps, true);
    return { ...kind, spans, lines, domain: [low, Math.max(high, 1.06 * kind.least)] };
  });
}

function motionPanels(run) {
  const spans = run.contact && run.leading.length ? run.contact[run.leading[0]] : [];
  const kinds = [
    { title: "position", unit: "m", values: run.position },
    { title: "velocity", unit: "m/s", values: run.velocity },
  ];
  return kinds.map((kind) => {
    const lines = run.focus.flatMap((node) => DASHES.slice(0, run.dimension).map((dash, axis) => ({
      name: axis === 0 ? run.nodeName[node] : "",
      colour: colourName(run, node),
      dash,
      perStep: false,
      read: (state) => kind.values[(state * run.nodes + node) * run.dimension + axis],
    })));
    return { ...kind, height: 100, spans, lines, domain: valueDomain(lines, run.steps + 1, false) };
  });
}

function drawTimePlots() {
  const run = clock.run;
  cursors.length = 0;
  drawGroup("belief-plots", beliefPanels(run));
  drawGroup("parameter-plots", parameterPanels(run));
  drawGroup("motion-plots", motionPanels(run));
  document.getElementById("no-contact").hidden = run.contact !== null;
  for (const moveCursor of cursors) moveCursor();
}

function startTimePlots() {
  redrawOnResize(document.querySelector(".stage-plots"), drawTimePlots);
  runListeners.push(drawTimePlots);
  timeListeners.push(() => cursors.forEach((moveCursor) => moveCursor()));
}
