// The scene from above on a canvas: goal, trails, plan, bodies, and the edges by belief.

const scene = { canvas: document.getElementById("scene"), colours: {}, toX: null, toY: null, scale: 1 };

function readColours() {
  const style = getComputedStyle(document.documentElement);
  const names = ["--ink", "--soft", "--faint", "--grid", "--sheet", "--belief", "--contact", "--goal", "--other"];
  for (const name of [...names, "--body-0", "--body-1", "--body-2", "--body-3"]) {
    scene.colours[name] = style.getPropertyValue(name).trim();
  }
}

// The smallest picture that holds every body at every time, and the goal.
function sceneBounds(run) {
  const low = [Infinity, Infinity];
  const high = [-Infinity, -Infinity];
  const include = (axis, value, margin) => {
    if (!Number.isFinite(value)) return;
    low[axis] = Math.min(low[axis], value - margin);
    high[axis] = Math.max(high[axis], value + margin);
  };
  for (let index = 0; index < run.position.length; index += 1) {
    const axis = index % run.dimension;
    const node = Math.floor(index / run.dimension) % run.nodes;
    if (axis < 2) include(axis, run.position[index], run.radius[node] ?? 0);
  }
  for (let node = 0; node < run.nodes; node += 1) {
    const hinge = run.anchor?.[node];
    for (let state = 0; hinge && state <= run.steps; state += 1) {
      [0, 1].forEach((axis) => include(axis, hinge[axis], run.radius[node] ?? 0));
      tipAt(run, node, state).forEach((value, axis) => include(axis, value, run.radius[node] ?? 0));
    }
  }
  if (run.goal) [0, 1].forEach((axis) => include(axis, run.goal[axis], run.goalRadius ?? 0));
  if (!Number.isFinite(low[0])) return { low: [-1, -1], high: [1, 1] };
  const margin = 0.06 * Math.max(high[0] - low[0], high[1] - low[1], 0.2);
  return { low: low.map((value) => value - margin), high: high.map((value) => value + margin) };
}

function layOutScene(width) {
  const run = clock.run;
  const { low, high } = sceneBounds(run);
  const size = [high[0] - low[0], high[1] - low[1]];
  const height = Math.round(width * Math.max(0.55, Math.min(1, size[1] / size[0])));
  const density = Math.max(1, window.devicePixelRatio || 1);
  scene.canvas.width = Math.round(width * density);
  scene.canvas.height = Math.round(height * density);
  scene.canvas.style.aspectRatio = `${width} / ${height}`;
  scene.scale = Math.min(width / size[0], height / size[1]);
  scene.width = width;
  scene.height = height;
  scene.density = density;
  scene.toX = (x) => width / 2 + (x - (low[0] + high[0]) / 2) * scene.scale;
  scene.toY = (y) => height / 2 - (y - (low[1] + high[1]) / 2) * scene.scale;
  scene.low = low;
  scene.high = high;
}

function stroke(draw, points, colour, width, alpha, dash = []) {
  draw.globalAlpha = alpha;
  draw.strokeStyle = colour;
  draw.lineWidth = width;
  draw.setLineDash(dash);
  draw.beginPath();
  points.forEach(([x, y], place) => (place ? draw.lineTo(x, y) : draw.moveTo(x, y)));
  draw.stroke();
  draw.setLineDash([]);
  draw.globalAlpha = 1;
}

function disc(draw, x, y, radius, fill, alpha) {
  draw.globalAlpha = alpha;
  draw.fillStyle = fill;
  draw.beginPath();
  draw.arc(x, y, radius, 0, 2 * Math.PI);
  draw.fill();
  draw.globalAlpha = 1;
}

function ring(draw, x, y, radius, colour, width, dash = []) {
  draw.strokeStyle = colour;
  draw.lineWidth = width;
  draw.setLineDash(dash);
  draw.beginPath();
  draw.arc(x, y, radius, 0, 2 * Math.PI);
  draw.stroke();
  draw.setLineDash([]);
}

// Lines every half metre (or what suits the scene), and a bar that says how long one is.
function drawGround(draw) {
  const { colours, toX, toY, width, height, scale } = scene;
  const spacing = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5].find((size) => size * scale >= width / 9) ?? 10;
  const reach = { x: width / 2 / scale, y: height / 2 / scale };
  const middle = [0, 1].map((axis) => (scene.low[axis] + scene.high[axis]) / 2);
  for (let x = Math.ceil((middle[0] - reach.x) / spacing) * spacing; x <= middle[0] + reach.x; x += spacing) {
    stroke(draw, [[toX(x), 0], [toX(x), height]], colours["--grid"], 1, 1);
  }
  for (let y = Math.ceil((middle[1] - reach.y) / spacing) * spacing; y <= middle[1] + reach.y; y += spacing) {
    stroke(draw, [[0, toY(y)], [width, toY(y)]], colours["--grid"], 1, 1);
  }
  const right = width - 14;
  stroke(draw, [[right - spacing * scale, height - 14], [right, height - 14]], colours["--soft"], 1.5, 1);
  draw.fillStyle = colours["--soft"];
  draw.textAlign = "right";
  draw.fillText(`${readable(spacing)} m`, right, height - 20);
}

function drawGoal(draw, run) {
  if (!run.goal || !run.goal.slice(0, 2).every(Number.isFinite)) return;
  const [x, y] = [scene.toX(run.goal[0]), scene.toY(run.goal[1])];
  const radius = (run.goalRadius ?? 0) * scene.scale;
  disc(draw, x, y, radius, scene.colours["--goal"], 0.1);
  ring(draw, x, y, radius, scene.colours["--goal"], 1.5, [4, 4]);
  draw.fillStyle = scene.colours["--goal"];
  draw.textAlign = "center";
  draw.fillText("goal", x, y - radius - 6);
}

// The whole way faintly, the way so far clearly.
function drawTrails(draw, run) {
  for (const node of run.involved) {
    const point = (step) => [scene.toX(positionAt(run, node, 0, step)), scene.toY(positionAt(run, node, 1, step))];
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
      const index = ((step * (horizon + 1) + ahead) * nodes.length + place) * 2;
      const [x, y] = [position[index], position[index + 1]];
      if (!Number.isFinite(x) || !Number.isFinite(y)) continue;
      const fade = 0.75 - (0.5 * ahead) / horizon;
      disc(draw, scene.toX(x), scene.toY(y), 2.1, scene.colours[colourName(run, node)], fade);
    }
  });
}

function drawBodies(draw, run) {
  const quietFirst = [...Array(run.nodes).keys()].sort((a, b) => run.involved.includes(a) - run.involved.includes(b));
  for (const node of quietFirst) {
    const [x, y] = [scene.toX(positionAt(run, node, 0, clock.step)), scene.toY(positionAt(run, node, 1, clock.step))];
    if (!Number.isFinite(x) || !Number.isFinite(y)) continue;
    const colour = scene.colours[colourName(run, node)];
    const radius = Math.max(3, (run.radius[node] ?? 0) * scene.scale);
    if (run.anchor?.[node]) {
      drawBar(draw, run, node, colour, radius);
      continue;
    }
    disc(draw, x, y, radius, scene.colours["--sheet"], 1);
    disc(draw, x, y, radius, colour, run.involved.includes(node) ? 0.3 : 0.22);
    ring(draw, x, y, radius - 1, colour, run.actuated[node] ? 3 : 1.6);
  }
}

// A hinged body: a bar from its hinge, a dot, to its tip.
function drawBar(draw, run, node, colour, radius) {
  const [hinge, tip] = [run.anchor[node], tipAt(run, node, clock.step)].map(([x, y]) => [scene.toX(x), scene.toY(y)]);
  const length = Math.hypot(tip[0] - hinge[0], tip[1] - hinge[1]) || 1;
  const aside = [(radius * (hinge[1] - tip[1])) / length, (radius * (tip[0] - hinge[0])) / length];
  const corner = (end, side) => [end[0] + side * aside[0], end[1] + side * aside[1]];
  const outline = [corner(hinge, 1), corner(tip, 1), corner(tip, -1), corner(hinge, -1), corner(hinge, 1)];
  const area = new Path2D(`M${outline.map((point) => point.join(" ")).join("L")}Z`);
  for (const [fill, alpha] of [[scene.colours["--sheet"], 1], [colour, run.involved.includes(node) ? 0.3 : 0.22]]) {
    draw.globalAlpha = alpha;
    draw.fillStyle = fill;
    draw.fill(area);
  }
  draw.globalAlpha = 1;
  stroke(draw, outline, colour, run.actuated[node] ? 3 : 1.6, 1);
  disc(draw, hinge[0], hinge[1], Math.max(2, 0.6 * radius), colour, 1);
}

function drawForce(draw, run) {
  if (run.controlSize < 2) return;
  const step = stepOf(run, clock.step);
  const [forceX, forceY] = [run.control[step * run.controlSize], run.control[step * run.controlSize + 1]];
  const size = Math.hypot(forceX, forceY);
  if (!(size > 1e-6)) return;
  const length = Math.min(0.16 * scene.width, 0.05 * size * scene.scale);
  const [alongX, alongY] = [forceX / size, -forceY / size];
  run.actuated.forEach((actuated, node) => {
    if (!actuated) return;
    const [x, y] = [scene.toX(positionAt(run, node, 0, clock.step)), scene.toY(positionAt(run, node, 1, clock.step))];
    const start = (run.radius[node] ?? 0) * scene.scale + 2;
    const [tipX, tipY] = [x + alongX * (start + length), y + alongY * (start + length)];
    const barb = (side) => [tipX - 6 * alongX - side * 3.5 * alongY, tipY - 6 * alongY + side * 3.5 * alongX];
    stroke(draw, [[x + alongX * start, y + alongY * start], [tipX, tipY]], scene.colours["--ink"], 1.4, 0.75);
    stroke(draw, [barb(1), [tipX, tipY], barb(-1)], scene.colours["--ink"], 1.4, 0.75);
  });
}
