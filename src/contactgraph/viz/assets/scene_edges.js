// The edges over the bodies, and the names of those.

function drawEdges(draw, scene) {
  scene.edges.forEach((pair, edge) => {
    const belief = beliefAt(scene, edge, clock.step);
    const touching = touches(scene, edge, clock.step);
    if (!(belief > 0.02) && !touching) return;
    const ends = pair.map((node) => toPixel(placeAt(scene, node, clock.step)));
    draw.lineCap = "round";
    if (touching) stroke(draw, ends, view.colours["--contact"], 13, 1);
    if (belief > 0.02) {
      stroke(draw, ends, view.colours["--belief"], 1 + 4 * belief, 0.15 + 0.85 * belief);
      for (const [x, y] of ends) disc(draw, x, y, 1.5 + 2.5 * belief, view.colours["--belief"], 0.15 + 0.85 * belief);
    }
    draw.lineCap = "butt";
  });
}

// Names stand on the far side of the partner, so that they do not cover each other or the edge,
// and on the near side where the picture ends; one below the other where bodies are in one place.
function drawNames(draw, scene) {
  const middle = scene.focus.map((node) => toPixel(placeAt(scene, node, clock.step))[0]);
  const taken = [];
  scene.involved.slice(0, 4).forEach((node) => {
    const [x, y] = toPixel(placeAt(scene, node, clock.step));
    const corners = outlinesAt(scene, node, clock.step).flat();
    const gap = Math.max(reachOf(scene, node)[0] * view.scale, ...corners.map((corner) => Math.abs(toPixel(corner)[0] - x))) + 7;
    const room = draw.measureText(scene.nodeName[node]).width + gap + 4;
    let right = scene.focus.length < 2 || x >= Math.min(...middle) + 0.5 * Math.abs(middle[0] - middle[1]);
    if (right ? x + room > view.width : x - room < 0) right = !right;
    let line = y + 4;
    while (taken.some((other) => other.right === right && Math.abs(other.x - x) < room && Math.abs(other.line - line) < 13)) line += 14;
    taken.push({ x, line, right });
    draw.textAlign = right ? "left" : "right";
    draw.fillStyle = view.colours[colourName(scene, node)];
    draw.fillText(scene.nodeName[node], x + (right ? gap : -gap), line);
  });
}
