// Which panels a scene has: beliefs, learned parameters, motion.

const DASHES = ["solid", "dashed", "dotted"]; // of the first, second and third axis

function beliefPanels(scene) {
  const read = (edge) => (step) => scene.belief[step * scene.edges.length + edge];
  const panels = scene.leading.map((edge) => ({
    title: scene.edgeName[edge],
    height: 44,
    domain: [0, 1],
    ticks: [0, 0.5, 1],
    spans: scene.contact ? scene.contact[edge] : [],
    lines: [{ name: "", colour: "--belief", perStep: true, read: read(edge) }],
  }));
  const rest = scene.edges.map((_, edge) => edge).filter((edge) => !scene.leading.includes(edge));
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

function parameterPanels(scene) {
  const spans = scene.contact && scene.leading.length ? scene.contact[scene.leading[0]] : [];
  const kinds = [
    { title: "inverse mass 1/m", unit: "1/kg", height: 110, values: scene.inverseMass, least: 0.1 },
    { title: "stiffness k/m", unit: "1/s²", height: 52, values: scene.stiffness, least: 0 },
    { title: "damping c/m", unit: "1/s", height: 52, values: scene.damping, least: 0 },
  ];
  return kinds.filter((kind) => kind.values).map((kind) => {
    const lines = scene.focus.flatMap((node) => kind.values.map((values, direction) => ({
      name: direction === 0 ? scene.nodeName[node] : "",
      colour: colourName(scene, node),
      dash: DASHES[direction],
      perStep: true,
      read: (step) => values[step * scene.nodes + node],
    })));
    const [low, high] = valueDomain(lines, scene.steps, true);
    return { ...kind, spans, lines, domain: [low, Math.max(high, 1.06 * kind.least)] };
  });
}

function motionPanels(scene) {
  const spans = scene.contact && scene.leading.length ? scene.contact[scene.leading[0]] : [];
  const kinds = [
    { title: "position", unit: "m", values: scene.position },
    { title: "velocity", unit: "m/s", values: scene.velocity },
  ];
  return kinds.map((kind) => {
    const lines = scene.focus.flatMap((node) => DASHES.slice(0, scene.dimension).map((dash, axis) => ({
      name: axis === 0 ? scene.nodeName[node] : "",
      colour: colourName(scene, node),
      dash,
      perStep: false,
      read: (state) => kind.values[(state * scene.nodes + node) * scene.dimension + axis],
    })));
    return { ...kind, height: 100, spans, lines, domain: valueDomain(lines, scene.steps + 1, false) };
  });
}

function drawTimePlots() {
  const scene = clock.scene;
  cursors.length = 0;
  drawGroup("belief-plots", beliefPanels(scene));
  drawGroup("parameter-plots", parameterPanels(scene));
  drawGroup("motion-plots", motionPanels(scene));
  document.getElementById("no-contact").hidden = scene.contact !== null;
  for (const moveCursor of cursors) moveCursor();
}

function startTimePlots() {
  redrawOnResize(document.querySelector(".stage-plots"), drawTimePlots);
  sceneListeners.push(drawTimePlots);
  timeListeners.push(() => cursors.forEach((moveCursor) => moveCursor()));
}
