// Goal, trails, plan and force.

function drawGoal(draw, scene) {
  if (!scene.goal || !scene.goal.every(Number.isFinite)) return;
  const [x, y] = toPixel(scene.goal);
  const radius = (scene.goalRadius ?? 0) * view.scale;
  disc(draw, x, y, radius, view.colours["--goal"], 0.1);
  ring(draw, x, y, radius, view.colours["--goal"], 1.5, [4, 4]);
  if (scene.ground) {
    const foot = toPixel([scene.goal[0], scene.goal[1], scene.ground.level]);
    stroke(draw, [[x, y], foot], view.colours["--goal"], 1, 1, [4, 4]);
  }
  draw.fillStyle = view.colours["--goal"];
  draw.textAlign = "center";
  draw.fillText("goal", x, y - radius - 6);
}

// The whole path faintly, the path so far clearly.
function drawTrails(draw, scene) {
  for (const node of scene.involved) {
    const point = (step) => toPixel(placeAt(scene, node, step));
    const colour = view.colours[colourName(scene, node)];
    const whole = Array.from({ length: scene.steps + 1 }, (_, state) => point(state));
    stroke(draw, whole, colour, 1, 0.22);
    stroke(draw, [...whole.slice(0, Math.floor(clock.step) + 1), point(clock.step)], colour, 1.6, 0.7);
  }
}

function drawPlan(draw, scene) {
  if (!scene.plan) return;
  const step = stepOf(scene, clock.step);
  const { nodes, horizon, position } = scene.plan;
  nodes.forEach((node, place) => {
    for (let ahead = 1; ahead <= horizon; ahead += 1) {
      const index = ((step * (horizon + 1) + ahead) * nodes.length + place) * scene.dimension;
      const [x, y] = toPixel(position.subarray(index, index + scene.dimension));
      if (!Number.isFinite(x) || !Number.isFinite(y)) continue;
      const fade = 0.75 - (0.5 * ahead) / horizon;
      disc(draw, x, y, 2.1, view.colours[colourName(scene, node)], fade);
    }
  });
}

// Pixels for a newton: 5 cm, or less where the scene's largest force would be far too long an arrow.
function forceScale(scene) {
  const largest = scene.control.reduce((most, value) => Math.max(most, Math.abs(value) || 0), 0);
  return Math.min(0.05 * view.scale, (0.4 * view.width) / largest);
}

function drawForce(draw, scene) {
  if (scene.controlSize < 2) return;
  const from = stepOf(scene, clock.step) * scene.controlSize;
  const force = scene.control.subarray(from, from + Math.min(scene.controlSize, scene.dimension));
  const [right, up] = project(force);
  const size = Math.hypot(right, up);
  if (!(size > 1e-6)) return;
  const length = Math.min(0.16 * view.width, forceScale(scene) * size);
  const [alongX, alongY] = [right / size, -up / size];
  scene.actuated.forEach((actuated, node) => {
    if (!actuated) return;
    const [x, y] = toPixel(placeAt(scene, node, clock.step));
    const start = (scene.radius[node] ?? 0) * view.scale + 2;
    const [tipX, tipY] = [x + alongX * (start + length), y + alongY * (start + length)];
    const barb = (side) => [tipX - 6 * alongX - side * 3.5 * alongY, tipY - 6 * alongY + side * 3.5 * alongX];
    stroke(draw, [[x + alongX * start, y + alongY * start], [tipX, tipY]], view.colours["--ink"], 1.4, 0.75);
    stroke(draw, [barb(1), [tipX, tipY], barb(-1)], view.colours["--ink"], 1.4, 0.75);
  });
}
