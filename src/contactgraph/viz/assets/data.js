// The page's data: `payload`, with each run's arrays decoded and ways to read them.

const payload = JSON.parse(document.getElementById("report-data").textContent);

function floats(text) {
  if (text === null) return null;
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

function decodeRun(raw) {
  const run = { ...raw, nodes: raw.nodeName.length, duration: raw.steps * raw.dt };
  for (const name of ["position", "velocity", "control", "belief", "skeleton"]) run[name] = floats(raw[name]);
  // One array for each direction that is shown.
  for (const name of ["inverseMass", "stiffness", "damping"]) run[name] = raw[name] && raw[name].map(floats);
  if (raw.plan) run.plan = { ...raw.plan, position: floats(raw.plan.position) };
  run.edgeName = raw.edges.map(([i, j]) => `${raw.nodeName[i]} and ${raw.nodeName[j]}`);
  return run;
}

payload.runs = payload.runs.map(decodeRun);
for (const loss of payload.losses) {
  loss.step = floats(loss.step);
  loss.value = floats(loss.value);
}

// A point at a time between two states, m; it is number `which` of `count` in `values`.
function between(run, values, count, which, step) {
  const before = Math.min(Math.floor(step), run.steps);
  const after = Math.min(before + 1, run.steps);
  const read = (state, axis) => values[(state * count + which) * run.dimension + axis];
  return Array.from({ length: run.dimension }, (_, axis) =>
    read(before, axis) + (step - before) * (read(after, axis) - read(before, axis)));
}

// Where a body is, m.
function placeAt(run, node, step) {
  return between(run, run.position, run.nodes, node, step);
}

// The free end of a hinged body, as far beyond its middle as its hinge is before it, m.
function tipAt(run, node, step) {
  return placeAt(run, node, step).map((value, axis) => 2 * value - run.anchor[node][axis]);
}

// The points of the body that is no node; none where there is no such body.
function skeletonAt(run, step) {
  const count = run.skeletonPoints;
  return Array.from({ length: count }, (_, point) => between(run, run.skeleton, count, point, step));
}

// The number of the step that a time lies in.
function stepOf(run, step) {
  return Math.max(0, Math.min(run.steps - 1, Math.floor(step)));
}

function beliefAt(run, edge, step) {
  return run.belief[stepOf(run, step) * run.edges.length + edge];
}

// Contact seen at a state is drawn over the step that led to it, as the belief about that step is.
function touches(run, edge, step) {
  if (!run.contact) return false;
  const state = stepOf(run, step) + 1;
  return run.contact[edge].some(([first, end]) => first <= state && state < end);
}

// Bodies the run is about have a colour each; bystanders share a quiet one.
function colourName(run, node) {
  const place = run.involved.indexOf(node);
  return place < 0 || place > 3 ? "--other" : `--body-${place}`;
}
