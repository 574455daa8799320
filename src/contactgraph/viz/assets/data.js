// The page's data: `payload`, with each scene's arrays decoded, and functions that read them.

const payload = JSON.parse(document.getElementById("report-data").textContent);

function floats(text) {
  if (text === null) return null;
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

function decodeScene(raw) {
  const scene = { ...raw, nodes: raw.nodeName.length, duration: raw.steps * raw.dt };
  for (const name of ["position", "velocity", "control", "belief", "linkPositions", "orientation"]) scene[name] = floats(raw[name]);
  // One array for each direction that is shown.
  for (const name of ["inverseMass", "stiffness", "damping"]) scene[name] = raw[name] && raw[name].map(floats);
  if (raw.plan) scene.plan = { ...raw.plan, position: floats(raw.plan.position) };
  scene.edgeName = raw.edges.map(([i, j]) => `${raw.nodeName[i]} and ${raw.nodeName[j]}`);
  return scene;
}

payload.scenes = payload.scenes.map(decodeScene);
for (const { lines } of payload.beliefs) for (const line of lines) line.belief = floats(line.belief);
for (const loss of payload.losses) {
  loss.step = floats(loss.step);
  loss.value = floats(loss.value);
}

// A point at a time between two states, m; it is number `which` of `count` in `values`.
function between(scene, values, count, which, step) {
  const before = Math.min(Math.floor(step), scene.steps);
  const after = Math.min(before + 1, scene.steps);
  const read = (state, axis) => values[(state * count + which) * scene.dimension + axis];
  return Array.from({ length: scene.dimension }, (_, axis) =>
    read(before, axis) + (step - before) * (read(after, axis) - read(before, axis)));
}

// Where a body is, m.
function placeAt(scene, node, step) {
  return between(scene, scene.position, scene.nodes, node, step);
}

// The polygons of a body where it is, m; none for a body without an outline. They are not turned where
// the orientation is not known.
function outlinesAt(scene, node, step) {
  const read = (state) => scene.orientation?.[Math.min(state, scene.steps) * scene.nodes + node] || 0;
  const before = read(Math.floor(step));
  const turn = read(Math.floor(step) + 1) - before;
  // The shorter way round.
  const angle = before + (step % 1) * (turn - 2 * Math.PI * Math.round(turn / (2 * Math.PI)));
  const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
  const [x, y] = placeAt(scene, node, step);
  return (scene.outlines?.[node] ?? []).map((outline) =>
    outline.map(([along, aside]) => [x + cosine * along - sine * aside, y + sine * along + cosine * aside]));
}

// The free end of a hinged body, as far beyond its middle as its hinge is before it, m.
function tipAt(scene, node, step) {
  return placeAt(scene, node, step).map((value, axis) => 2 * value - scene.anchor[node][axis]);
}

// The points of the body that is no node; none where there is no such body.
function linksAt(scene, step) {
  const count = scene.linkPoints;
  return Array.from({ length: count }, (_, point) => between(scene, scene.linkPositions, count, point, step));
}

// The number of the step that a time lies in.
function stepOf(scene, step) {
  return Math.max(0, Math.min(scene.steps - 1, Math.floor(step)));
}

function beliefAt(scene, edge, step) {
  return scene.belief[stepOf(scene, step) * scene.edges.length + edge];
}

// Contact seen at a state is drawn over the step that led to it, as the belief about that step is.
function touches(scene, edge, step) {
  if (!scene.contact) return false;
  const state = stepOf(scene, step) + 1;
  return scene.contact[edge].some(([first, end]) => first <= state && state < end);
}

// Bodies of the task have a colour each; distractors share a muted one.
function colourName(scene, node) {
  const place = scene.involved.indexOf(node);
  return place < 0 || place > 3 ? "--other" : `--body-${place}`;
}
