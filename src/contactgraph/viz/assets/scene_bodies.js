// The bodies: balls, boxes, bars on hinges; an arm; and in space what they shade.

// Far ones first, bystanders first among those as far away; what moves the others comes last, so
// that nothing it holds hides it.
function drawBodies(draw, run) {
  const order = [...Array(run.nodes).keys()].map((node) => {
    const place = placeAt(run, node, clock.step);
    return { node, place, near: depth(place) || 0 };
  });
  order.sort((a, b) => run.actuated[a.node] - run.actuated[b.node] || a.near - b.near
    || run.involved.includes(a.node) - run.involved.includes(b.node));
  for (const { node, place } of order) {
    if (place.every(Number.isFinite)) drawBody(draw, run, node, place);
  }
}

function drawBody(draw, run, node, place) {
  const colour = scene.colours[colourName(run, node)];
  const radius = Math.max(3, (run.radius[node] ?? 0) * scene.scale);
  const [strength, width] = [run.involved.includes(node) ? 0.3 : 0.22, run.actuated[node] ? 3 : 1.6];
  if (run.anchor?.[node]) {
    drawBar(draw, run, node, radius, colour, strength, width);
  } else if (run.box[node]) {
    // A shade for each face, so that a box looks solid.
    boxFaces(place, run.box[node]).forEach((face, side) => drawFace(draw, face, colour, strength * [1, 1.4, 0.7][side], width));
  } else {
    const [x, y] = toPixel(place);
    // In the plane nothing is behind: opaque, so that trails and plans end at the rim.
    if (run.dimension < 3) disc(draw, x, y, radius, scene.colours["--sheet"], 1);
    disc(draw, x, y, radius, colour, strength);
    ring(draw, x, y, radius - 1, colour, width);
  }
}

function drawFace(draw, corners, colour, strength, width) {
  area(draw, corners, scene.colours["--sheet"], 1);
  area(draw, corners, colour, strength);
  draw.lineJoin = "round";
  stroke(draw, [...corners, corners[0], corners[1]], colour, width, 1);
  draw.lineJoin = "miter";
}

// A hinged body: a bar from its hinge, a dot, to its tip.
function drawBar(draw, run, node, radius, colour, strength, width) {
  const [hinge, tip] = [run.anchor[node], tipAt(run, node, clock.step)].map(toPixel);
  const length = Math.hypot(tip[0] - hinge[0], tip[1] - hinge[1]) || 1;
  const aside = [(radius * (hinge[1] - tip[1])) / length, (radius * (tip[0] - hinge[0])) / length];
  const corner = (end, side) => [end[0] + side * aside[0], end[1] + side * aside[1]];
  drawFace(draw, [corner(hinge, 1), corner(tip, 1), corner(tip, -1), corner(hinge, -1)], colour, strength, width);
  disc(draw, hinge[0], hinge[1], Math.max(2, 0.6 * radius), colour, 1);
}

// A body that is no node, such as an arm: bones and joints.
function drawSkeleton(draw, run) {
  const points = skeletonAt(run, clock.step).map(toPixel);
  if (!points.length) return;
  const thickness = 0.018 * scene.width;
  [draw.lineCap, draw.lineJoin] = ["round", "round"];
  stroke(draw, points, scene.colours["--bone"], thickness, 1);
  [draw.lineCap, draw.lineJoin] = ["butt", "miter"];
  for (const [x, y] of points) disc(draw, x, y, 0.22 * thickness, scene.colours["--soft"], 1);
}

// Where every body is above the ground.
function drawShadows(draw, run) {
  if (!run.ground) return;
  const round = Array.from({ length: 32 }, (_, k) => [Math.cos((k * Math.PI) / 16), Math.sin((k * Math.PI) / 16)]);
  for (let node = 0; node < run.nodes; node += 1) {
    const place = placeAt(run, node, clock.step);
    if (!place.every(Number.isFinite)) continue;
    const half = run.box[node] ? run.box[node].map((length) => length / 2) : Array(3).fill(run.radius[node] ?? 0);
    const outline = run.box[node] ? [[1, 1], [1, -1], [-1, -1], [-1, 1]] : round;
    const rim = outline.map(([x, y]) => toPixel([place[0] + x * half[0], place[1] + y * half[1], run.ground.level]));
    area(draw, rim, scene.colours["--ink"], 0.12);
  }
}
