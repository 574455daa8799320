// The hand: dragging the goal by its rim, and bodies.

const RIM = 12; // px to either side of the rim, and beyond a body
const hand = {
  goal: null, // where it is dragged to, until the session has acted on that
  node: null,
  to: null,
  from: null, // px and m, where the drag began
  sent: new Map(), // when a goal was sent, ms, by its number
  number: 0,
  due: null,
};

function sendDue() {
  if (hand.due) send(hand.due);
  hand.due = null;
}

// At most one message a picture.
function sendSoon(message) {
  if (!hand.due) requestAnimationFrame(sendDue);
  if (message.wish === "goal") hand.sent.set(message.number, performance.now());
  hand.due = message;
}

function pixelOf(event) {
  const box = view.canvas.getBoundingClientRect();
  return [((event.clientX - box.left) * view.width) / box.width, ((event.clientY - box.top) * view.height) / box.height];
}

// What lies under the pointer: a node, "goal", or null.
function handleAt([x, y]) {
  const { scene } = clock;
  if (!scene || !clock.scene.disturbable) return null;
  let [found, nearest] = [null, Infinity];
  for (let node = 0; node < scene.nodes; node += 1) {
    const [bodyX, bodyY] = toPixel(placeAt(scene, node, clock.step));
    const away = Math.hypot(x - bodyX, y - bodyY);
    const reach = Math.max(10, reachOf(scene, node)[0] * view.scale + 3);
    if (away < reach && away < nearest) [found, nearest] = [node, away];
  }
  if (found !== null) return found;
  if (!scene.goal) return null;
  const [goalX, goalY] = toPixel(scene.goal);
  const off = Math.hypot(x - goalX, y - goalY) - (scene.goalRadius ?? 0) * view.scale;
  return Math.abs(off) < RIM ? "goal" : null;
}

// A place that is moved by pixels, in the plane of the picture.
function moved(place, [fromX, fromY], [x, y]) {
  const [right, up] = [(x - fromX) / view.scale, (fromY - y) / view.scale];
  return place.map((value, axis) => value + right * (view.axes[0][axis] ?? 0) + up * (view.axes[1][axis] ?? 0));
}

function beginDrag(event) {
  const pixel = pixelOf(event);
  const handle = handleAt(pixel);
  if (handle === null) return;
  event.stopImmediatePropagation(); // not to turn the picture
  event.preventDefault();
  view.canvas.setPointerCapture(event.pointerId);
  view.canvas.classList.add("dragging");
  const { scene } = clock;
  if (handle === "goal") {
    hand.from = { pixel, place: [...scene.goal] };
    hand.goal = [...scene.goal];
  } else {
    hand.from = { pixel, place: placeAt(scene, handle, clock.step) };
    hand.node = handle;
    hand.to = [...hand.from.place];
    sendSoon({ wish: "pull", node: hand.node, to: hand.to });
  }
}

function drag(event) {
  if (!hand.from) {
    view.canvas.classList.toggle("on-handle", handleAt(pixelOf(event)) !== null);
    return;
  }
  event.stopImmediatePropagation();
  const place = moved(hand.from.place, hand.from.pixel, pixelOf(event));
  if (hand.node === null) {
    hand.goal = clock.scene.goal = place;
    hand.number += 1;
    sendSoon({ wish: "goal", goal: place, number: hand.number });
  } else {
    hand.to = place;
    sendSoon({ wish: "pull", node: hand.node, to: place });
  }
  live.dirty = true;
}

function endDrag() {
  if (!hand.from) return;
  sendDue();
  if (hand.node !== null) send({ wish: "release" });
  letGo();
  live.dirty = true;
}

function letGo() {
  [hand.from, hand.goal, hand.node, hand.to, hand.due] = [null, null, null, null, null];
  view.canvas.classList.remove("dragging");
}

function startHand() {
  const { canvas } = view;
  canvas.addEventListener("pointerdown", beginDrag);
  canvas.addEventListener("pointermove", drag);
  canvas.addEventListener("pointerup", endDrag);
  canvas.addEventListener("pointercancel", endDrag);
}
