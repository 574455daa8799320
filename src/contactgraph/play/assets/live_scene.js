// The scene as it moves: the last states in the arrays that the report's renderer reads.

const HISTORY = 60; // steps whose states are drawn as trails

const live = {
  number: null, // of the scene
  step: null, // of the newest state
  time: 0,
  frame: null,
  arrived: 0, // ms, by the page's clock
  span: 50, // ms from the state before to the newest one
  dirty: true,
};

function repeated(first, times) {
  const whole = new Float32Array(first.length * times);
  for (let each = 0; each < times; each += 1) whole.set(first, each * first.length);
  return whole;
}

function liveScene(raw) {
  const scene = decodeScene(raw);
  const first = (values, width) => values && repeated(values.subarray(0, width), HISTORY + 1);
  scene.position = first(scene.position, scene.nodes * scene.dimension);
  scene.orientation = first(scene.orientation, scene.nodes);
  scene.linkPositions = first(scene.linkPositions, scene.linkPoints * scene.dimension);
  scene.steps = HISTORY;
  scene.control = new Float32Array(HISTORY * scene.controlSize);
  scene.belief = new Float32Array(HISTORY * scene.edges.length);
  scene.touched = new Uint8Array(HISTORY * scene.edges.length);
  scene.contact = scene.edges.map(() => []);
  scene.plan = { nodes: [], horizon: 1, position: new Float32Array(0) };
  return scene;
}

// The oldest entry goes, the newest comes; each entry has as many numbers as there are values.
function shiftIn(whole, values) {
  if (!whole || !values || !values.length) return;
  whole.copyWithin(0, values.length);
  whole.set(values.map((value) => value ?? NaN), whole.length - values.length);
}

function takeMotion(scene, frame) {
  shiftIn(scene.position, frame.position);
  shiftIn(scene.orientation, frame.orientation);
  shiftIn(scene.linkPositions, frame.links);
  shiftIn(scene.control, frame.control.slice(0, scene.controlSize));
  shiftIn(scene.belief, frame.belief);
  const touching = new Uint8Array(scene.edges.length);
  for (const edge of frame.contact) touching[edge] = 1;
  shiftIn(scene.touched, touching);
  scene.contact = scene.edges.map((_, edge) => (touching[edge] ? [[HISTORY, HISTORY + 1]] : []));
  // The renderer reads the plan of the last step alone.
  const { nodes, horizon, position } = frame.plan;
  const whole = new Float32Array(HISTORY * position.length);
  whole.set(position.map((value) => value ?? NaN), (HISTORY - 1) * position.length);
  scene.plan = { nodes, horizon, position: whole };
}

function takeFrame(frame) {
  if (frame.scene !== live.number) return;
  const { scene } = clock;
  if (frame.step !== undefined && frame.step !== live.step) {
    takeMotion(scene, frame);
    live.span = live.step === null ? 0 : (1000 * (frame.time - live.time)) / frame.speed;
    live.step = frame.step;
    live.time = frame.time;
    live.arrived = performance.now();
    scene.nodeName.forEach((_, node) => keepInView(scene, node));
  }
  live.frame = frame;
  if (frame.goal && !hand.goal) scene.goal = frame.goal;
  live.dirty = true;
}

// The picture grows where a body of the task leaves it.
function keepInView(scene, node) {
  if (!scene.involved.includes(node) || !view.toX) return;
  const place = placeAt(scene, node, HISTORY);
  const [x, y] = toPixel(place);
  if (x > 0 && x < view.width && y > 0 && y < view.height) return;
  const half = [view.width / 2 / view.scale, view.height / 2 / view.scale];
  const [low, high] = [-1, 1].map((sign) => view.middle.map((middle, side) => middle + sign * half[side]));
  project(place).forEach((value, side) => {
    low[side] = Math.min(low[side], value - 0.1 * half[side]);
    high[side] = Math.max(high[side], value + 0.1 * half[side]);
  });
  if ([...low, ...high].every(Number.isFinite)) fitScene({ low, high });
}

// Where the plan takes the bodies: their rims, ever fainter.
function drawGhosts(draw, scene) {
  const { nodes, horizon, position } = scene.plan;
  nodes.forEach((node, place) => {
    for (const share of [1 / 3, 2 / 3, 1]) {
      const index = (((HISTORY - 1) * (horizon + 1) + Math.round(share * horizon)) * nodes.length + place) * scene.dimension;
      const [x, y] = toPixel(position.subarray(index, index + scene.dimension));
      if (!Number.isFinite(x) || !Number.isFinite(y)) continue;
      draw.globalAlpha = 0.6 - 0.4 * share;
      ring(draw, x, y, Math.max(4, reachOf(scene, node)[0] * view.scale), view.colours[colourName(scene, node)], 1.4);
      draw.globalAlpha = 1;
    }
  });
}

// The line from a pulled body to the hand.
function drawHand(draw, scene) {
  if (hand.node === null) return;
  const ends = [toPixel(placeAt(scene, hand.node, clock.step)), toPixel(hand.to)];
  stroke(draw, ends, view.colours["--ink"], 1.4, 0.8, [3, 3]);
  disc(draw, ...ends[1], 4, view.colours["--ink"], 0.8);
}

function drawLive(now) {
  requestAnimationFrame(drawLive);
  if (!clock.scene || !live.frame) return;
  const share = live.span > 0 && !live.frame.paused ? Math.min(1, (now - live.arrived) / live.span) : 1;
  const step = HISTORY - 1 + Math.max(0, share);
  if (step === clock.step && !live.dirty) return;
  live.dirty = false;
  clock.step = step;
  drawScene();
  const draw = view.canvas.getContext("2d");
  drawGhosts(draw, clock.scene);
  drawHand(draw, clock.scene);
  noteFrame();
}

// What a test or a measurement reads of the picture: its number, places in it, and the last lag.
function noteFrame() {
  const { dataset } = view.canvas;
  const { scene } = clock;
  const places = Object.fromEntries(scene.nodeName.map((_, node) => [node, toPixel(placeAt(scene, node, clock.step))]));
  if (scene.goal) {
    const [x, y] = toPixel(scene.goal);
    Object.assign(places, { goal: [x, y], rim: [x + scene.goalRadius * view.scale, y] });
  }
  dataset.at = JSON.stringify({ ...places, middle: [view.width / 2, view.height / 2] });
  dataset.scene = live.number;
  dataset.frames = Number(dataset.frames ?? 0) + 1;
  const sent = hand.sent.get(live.frame.acted);
  if (sent === undefined) return;
  for (const number of hand.sent.keys()) if (number <= live.frame.acted) hand.sent.delete(number);
  dataset.lag = (performance.now() - sent).toFixed(1); // ms from a drag to its plan in the picture
  dataset.lags = Number(dataset.lags ?? 0) + 1;
}
