// Where bodies come from and where they go: goal, trails, plan, force.

function drawGoal(draw, run) {
  if (!run.goal || !run.goal.every(Number.isFinite)) return;
  const [x, y] = toPixel(run.goal);
  const radius = (run.goalRadius ?? 0) * scene.scale;
  disc(draw, x, y, radius, scene.colours["--goal"], 0.1);
  ring(draw, x, y, radius, scene.colours["--goal"], 1.5, [4, 4]);
  if (run.ground) {
    const foot = toPixel([run.goal[0], run.goal[1], run.ground.level]);
    stroke(draw, [[x, y], foot], scene.colours["--goal"], 1, 1, [4, 4]);
  }
  draw.fillStyle = scene.colours["--goal"];
  draw.textAlign = "center";
  draw.fillText("goal", x, y - radius - 6);
}

// The whole way faintly, the way so far clearly.
function drawTrails(draw, run) {
  for (const node of run.involved) {
    const point = (step) => toPixel(placeAt(run, node, step));
    const colour = scene.colours[colourName(run, node)];
    const whole = Array.from({ length: run.steps + 1 }, (_, state) => point(state));
    stroke(draw, whole, colour, 1, 0.22);
    stroke(draw, [...whole.slice(0, Math.floor(clock.step) + 1), point(clock.step)], colour, 1.6, 0.7);
  }
}

function drawPlan(draw, run) {
  if (!run.plan) return;
  const step = stepOf(run, clock.step);
  const { nodes, horizon, position } = run.plan;
  nodes.forEach((node, place) => {
    for (let ahead = 1; ahead <= horizon; ahead += 1) {
      const index = ((step * (horizon + 1) + ahead) * nodes.length + place) * run.dimension;
      const [x, y] = toPixel(position.subarray(index, index + run.dimension));
      if (!Number.isFinite(x) || !Number.isFinite(y)) continue;
      const fade = 0.75 - (0.5 * ahead) / horizon;
      disc(draw, x, y, 2.1, scene.colours[colourName(run, node)], fade);
    }
  });
}

// Pixels for a newton: 5 cm, or less where the run's largest force would be far too long an arrow.
function forceScale(run) {
  const largest = run.control.reduce((most, value) => Math.max(most, Math.abs(value) || 0), 0);
  return Math.min(0.05 * scene.scale, (0.4 * scene.width) / largest);
}

function drawForce(draw, run) {
  if (run.controlSize < 2) return;
  const from = stepOf(run, clock.step) * run.controlSize;
  const force = run.control.subarray(from, from + Math.min(run.controlSize, run.dimension));
  const [right, up] = project(force);
  const size = Math.hypot(right, up);
  if (!(size > 1e-6)) return;
  const length = Math.min(0.16 * scene.width, forceScale(run) * size);
  const [alongX, alongY] = [right / size, -up / size];
  run.actuated.forEach((actuated, node) => {
    if (!actuated) return;
    const [x, y] = toPixel(placeAt(run, node, clock.step));
    const start = (run.radius[node] ?? 0) * scene.scale + 2;
    const [tipX, tipY] = [x + alongX * (start + length), y + alongY * (start + length)];
    const barb = (side) => [tipX - 6 * alongX - side * 3.5 * alongY, tipY - 6 * alongY + side * 3.5 * alongX];
    stroke(draw, [[x + alongX * start, y + alongY * start], [tipX, tipY]], scene.colours["--ink"], 1.4, 0.75);
    stroke(draw, [barb(1), [tipX, tipY], barb(-1)], scene.colours["--ink"], 1.4, 0.75);
  });
}
