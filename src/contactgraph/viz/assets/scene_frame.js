// How large the picture is, and what it stands on.

// The smallest picture that holds every body at every time, the goal, and the ground.
function sceneBounds(scene) {
  const low = [Infinity, Infinity];
  const high = [-Infinity, -Infinity];
  const include = (point, reach) => {
    project(point).forEach((value, side) => {
      if (!Number.isFinite(value)) return;
      low[side] = Math.min(low[side], value - reach[side]);
      high[side] = Math.max(high[side], value + reach[side]);
    });
  };
  for (let node = 0; node < scene.nodes; node += 1) {
    const reach = reachOf(scene, node);
    const hinge = scene.anchor?.[node];
    for (let state = 0; state <= scene.steps; state += 1) {
      include(placeAt(scene, node, state), reach);
      outlinesAt(scene, node, state).flat().forEach((corner) => include(corner, [0, 0]));
      if (hinge) [hinge, tipAt(scene, node, state)].forEach((end) => include(end, reach));
    }
  }
  for (let state = 0; state <= scene.steps; state += 1) {
    linksAt(scene, state).forEach((point) => include(point, [0, 0]));
  }
  if (scene.goal) include(scene.goal, [scene.goalRadius ?? 0, scene.goalRadius ?? 0]);
  if (scene.ground) groundCorners(scene.ground).forEach((corner) => include(corner, [0, 0]));
  if (!Number.isFinite(low[0])) return { low: [-1, -1], high: [1, 1] };
  const margin = 0.06 * Math.max(high[0] - low[0], high[1] - low[1], 0.2);
  return { low: low.map((value) => value - margin), high: high.map((value) => value + margin) };
}

function groundCorners({ low, high, level }) {
  return [low, [high[0], low[1]], high, [low[0], high[1]]].map(([x, y]) => [x, y, level]);
}

function layOutScene(width) {
  const bounds = sceneBounds(clock.scene);
  const size = [0, 1].map((side) => bounds.high[side] - bounds.low[side]);
  const height = Math.round(width * Math.max(0.55, Math.min(1, size[1] / size[0])));
  const density = Math.max(1, window.devicePixelRatio || 1);
  view.canvas.width = Math.round(width * density);
  view.canvas.height = Math.round(height * density);
  view.canvas.style.aspectRatio = `${width} / ${height}`;
  view.width = width;
  view.height = height;
  view.density = density;
  fitScene(bounds);
}

// Puts what lies between two corners, m in the picture, in the middle of the canvas.
function fitScene({ low, high }) {
  const { width, height } = view;
  view.scale = Math.min(width / (high[0] - low[0]), height / (high[1] - low[1]));
  view.middle = [0, 1].map((side) => (low[side] + high[side]) / 2);
  view.toX = (x) => width / 2 + (x - view.middle[0]) * view.scale;
  view.toY = (y) => height / 2 - (y - view.middle[1]) * view.scale;
}

// In the plane the ground is all that is seen; a square is half a metre, or a length that suits the scene.
function planeGround() {
  const { width, height, scale, middle } = view;
  const spacing = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5].find((size) => size * scale >= width / 9) ?? 10;
  const reach = [width / 2 / scale, height / 2 / scale];
  return { low: middle.map((at, side) => at - reach[side]), high: middle.map((at, side) => at + reach[side]), level: 0, spacing };
}

function drawGround(draw, scene) {
  const ground = scene.ground ?? planeGround();
  const { low, high, level, spacing } = ground;
  const { colours } = view;
  if (scene.ground) area(draw, groundCorners(ground).map(toPixel), colours["--ground"], 1);
  for (const axis of [0, 1]) {
    for (let k = Math.ceil(low[axis] / spacing - 1e-6); k * spacing <= high[axis] + 1e-6 * spacing; k += 1) {
      const ends = [low, high].map((corner) => [...corner, level]);
      for (const end of ends) end[axis] = k * spacing;
      stroke(draw, ends.map(toPixel), colours[scene.ground ? "--rule" : "--grid"], 1, 1);
    }
  }
  if (scene.ground) drawAxes3(draw, ground);
  else drawScaleBar(draw, spacing);
}

// The planes of a scene in the plane, such as a floor and walls, as lines across the picture.
function drawPlanes(draw, scene) {
  const [right, up] = view.middle;
  const far = (view.width + view.height) / view.scale;
  for (const [x, y, offset] of scene.planes ?? []) {
    const off = x * right + y * up - offset;
    const ends = [-far, far].map((along) => toPixel([right - off * x - along * y, up - off * y + along * x]));
    stroke(draw, ends, view.colours["--soft"], 1.5, 1);
  }
}

// A bar that says how long the side of a square is.
function drawScaleBar(draw, spacing) {
  const { colours, width, height, scale } = view;
  const right = width - 14;
  stroke(draw, [[right - spacing * scale, height - 14], [right, height - 14]], colours["--soft"], 1.5, 1);
  draw.fillStyle = colours["--soft"];
  draw.textAlign = "right";
  draw.fillText(`${readable(spacing)} m`, right, height - 20);
}

// In space, the three axes at a corner of the ground, as long as the side of a square.
function drawAxes3(draw, { low, level, spacing }) {
  const { colours } = view;
  const corner = [...low, level];
  const [fromX, fromY] = toPixel(corner);
  draw.fillStyle = colours["--soft"];
  draw.textAlign = "center";
  ["x", "y", "z"].forEach((name, axis) => {
    const end = [...corner];
    end[axis] += spacing;
    const [x, y] = toPixel(end);
    const length = Math.hypot(x - fromX, y - fromY);
    if (length < 6) return; // seen from its end
    stroke(draw, [[fromX, fromY], [x, y]], colours["--soft"], 1.5, 1);
    draw.fillText(name, x + (9 * (x - fromX)) / length, y + (9 * (y - fromY)) / length + 4);
  });
  draw.fillText(`${readable(spacing)} m`, fromX, fromY + 16);
}
