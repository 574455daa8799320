// The bodies: balls, boxes, polygons, bars on hinges; an arm; and in space what they shade.

// Far ones first, distractors first among those as far away; what moves the others comes last, so
// that nothing it holds hides it.
function drawBodies(draw, scene) {
  const order = [...Array(scene.nodes).keys()].map((node) => {
    const place = placeAt(scene, node, clock.step);
    return { node, place, near: depth(place) || 0 };
  });
  order.sort((a, b) => scene.actuated[a.node] - scene.actuated[b.node] || a.near - b.near
    || scene.involved.includes(a.node) - scene.involved.includes(b.node));
  for (const { node, place } of order) {
    if (place.every(Number.isFinite)) drawBody(draw, scene, node, place);
  }
}

function drawBody(draw, scene, node, place) {
  const colour = view.colours[colourName(scene, node)];
  const radius = Math.max(3, (scene.radius[node] ?? 0) * view.scale);
  const [strength, width] = [scene.involved.includes(node) ? 0.3 : 0.22, scene.actuated[node] ? 3 : 1.6];
  const outlines = outlinesAt(scene, node, clock.step).map((outline) => outline.map(toPixel));
  if (outlines.length) {
    drawOutlines(draw, outlines, colour, strength, width);
  } else if (scene.anchor?.[node]) {
    drawBar(draw, scene, node, radius, colour, strength, width);
  } else if (scene.box[node]) {
    // A shade for each face, so that a box looks solid.
    boxFaces(place, scene.box[node]).forEach((face, side) => drawFace(draw, face, colour, strength * [1, 1.4, 0.7][side], width));
  } else {
    const [x, y] = toPixel(place);
    // In the plane nothing is behind: opaque, so that trails and plans end at the rim.
    if (scene.dimension < 3) disc(draw, x, y, radius, view.colours["--sheet"], 1);
    disc(draw, x, y, radius, colour, strength);
    ring(draw, x, y, radius - 1, colour, width);
  }
}

function drawFace(draw, corners, colour, strength, width) {
  area(draw, corners, view.colours["--sheet"], 1);
  area(draw, corners, colour, strength);
  draw.lineJoin = "round";
  stroke(draw, [...corners, corners[0], corners[1]], colour, width, 1);
  draw.lineJoin = "miter";
}

// A union of polygons, in pixels: rims first, so that none is seen inside. Lines to a corner of the first
// and back make them one area without seams.
function drawOutlines(draw, outlines, colour, strength, width) {
  draw.lineJoin = "round";
  for (const each of outlines) stroke(draw, [...each, each[0], each[1]], colour, 2 * width, 1);
  draw.lineJoin = "miter";
  const corners = outlines.flatMap((each) => [...each, each[0], outlines[0][0]]);
  area(draw, corners, view.colours["--sheet"], 1);
  area(draw, corners, colour, strength);
}

// A hinged body: a bar from its hinge, a dot, to its tip.
function drawBar(draw, scene, node, radius, colour, strength, width) {
  const [hinge, tip] = [scene.anchor[node], tipAt(scene, node, clock.step)].map(toPixel);
  const length = Math.hypot(tip[0] - hinge[0], tip[1] - hinge[1]) || 1;
  const aside = [(radius * (hinge[1] - tip[1])) / length, (radius * (tip[0] - hinge[0])) / length];
  const corner = (end, side) => [end[0] + side * aside[0], end[1] + side * aside[1]];
  drawFace(draw, [corner(hinge, 1), corner(tip, 1), corner(tip, -1), corner(hinge, -1)], colour, strength, width);
  disc(draw, hinge[0], hinge[1], Math.max(2, 0.6 * radius), colour, 1);
}

// A body that is no node, such as an arm: bones and joints.
function drawLinks(draw, scene) {
  const points = linksAt(scene, clock.step).map(toPixel);
  if (!points.length) return;
  const thickness = 0.018 * view.width;
  [draw.lineCap, draw.lineJoin] = ["round", "round"];
  stroke(draw, points, view.colours["--bone"], thickness, 1);
  [draw.lineCap, draw.lineJoin] = ["butt", "miter"];
  for (const [x, y] of points) disc(draw, x, y, 0.22 * thickness, view.colours["--soft"], 1);
}

// Where every body is above the ground.
function drawShadows(draw, scene) {
  if (!scene.ground) return;
  const round = Array.from({ length: 32 }, (_, k) => [Math.cos((k * Math.PI) / 16), Math.sin((k * Math.PI) / 16)]);
  for (let node = 0; node < scene.nodes; node += 1) {
    const place = placeAt(scene, node, clock.step);
    if (!place.every(Number.isFinite)) continue;
    const half = scene.box[node] ? scene.box[node].map((length) => length / 2) : Array(3).fill(scene.radius[node] ?? 0);
    const outline = scene.box[node] ? [[1, 1], [1, -1], [-1, -1], [-1, 1]] : round;
    const rim = outline.map(([x, y]) => toPixel([place[0] + x * half[0], place[1] + y * half[1], scene.ground.level]));
    area(draw, rim, view.colours["--ink"], 0.12);
  }
}
