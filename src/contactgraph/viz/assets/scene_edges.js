// The edges over the bodies, and the names of those.

function drawEdges(draw, run) {
  run.edges.forEach((pair, edge) => {
    const belief = beliefAt(run, edge, clock.step);
    const touching = touches(run, edge, clock.step);
    if (!(belief > 0.02) && !touching) return;
    const ends = pair.map((node) => toPixel(placeAt(run, node, clock.step)));
    draw.lineCap = "round";
    if (touching) stroke(draw, ends, scene.colours["--contact"], 13, 1);
    if (belief > 0.02) {
      stroke(draw, ends, scene.colours["--belief"], 1 + 4 * belief, 0.15 + 0.85 * belief);
      for (const [x, y] of ends) disc(draw, x, y, 1.5 + 2.5 * belief, scene.colours["--belief"], 0.15 + 0.85 * belief);
    }
    draw.lineCap = "butt";
  });
}

// Names stand on the far side of the partner, so that they do not cover each other or the edge,
// and on the near side where the picture ends; one below the other where bodies are in one place.
function drawNames(draw, run) {
  const middle = run.focus.map((node) => toPixel(placeAt(run, node, clock.step))[0]);
  const taken = [];
  run.involved.slice(0, 4).forEach((node) => {
    const [x, y] = toPixel(placeAt(run, node, clock.step));
    const gap = reachOf(run, node)[0] * scene.scale + 7;
    const room = draw.measureText(run.nodeName[node]).width + gap + 4;
    let right = run.focus.length < 2 || x >= Math.min(...middle) + 0.5 * Math.abs(middle[0] - middle[1]);
    if (right ? x + room > scene.width : x - room < 0) right = !right;
    let line = y + 4;
    while (taken.some((other) => other.right === right && Math.abs(other.x - x) < room && Math.abs(other.line - line) < 13)) line += 14;
    taken.push({ x, line, right });
    draw.textAlign = right ? "left" : "right";
    draw.fillStyle = scene.colours[colourName(run, node)];
    draw.fillText(run.nodeName[node], x + (right ? gap : -gap), line);
  });
}
