// The edges over the bodies, their names, and the scene as a whole.

function drawEdges(draw, run) {
  run.edges.forEach(([first, second], edge) => {
    const belief = beliefAt(run, edge, clock.step);
    const touching = touches(run, edge, clock.step);
    if (!(belief > 0.02) && !touching) return;
    const ends = [first, second].map((node) => [
      scene.toX(positionAt(run, node, 0, clock.step)),
      scene.toY(positionAt(run, node, 1, clock.step)),
    ]);
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
// and on the near side where the picture ends.
function drawNames(draw, run) {
  const middle = run.focus.map((node) => positionAt(run, node, 0, clock.step));
  run.involved.slice(0, 4).forEach((node) => {
    const x = positionAt(run, node, 0, clock.step);
    const place = scene.toX(x);
    const gap = (run.radius[node] ?? 0) * scene.scale + 7;
    const room = draw.measureText(run.nodeName[node]).width + gap + 4;
    let right = run.focus.length < 2 || x >= Math.min(...middle) + 0.5 * Math.abs(middle[0] - middle[1]);
    if (right ? place + room > scene.width : place - room < 0) right = !right;
    draw.textAlign = right ? "left" : "right";
    draw.fillStyle = scene.colours[colourName(run, node)];
    draw.fillText(run.nodeName[node], place + (right ? gap : -gap), scene.toY(positionAt(run, node, 1, clock.step)) + 4);
  });
}

function drawScene() {
  const draw = scene.canvas.getContext("2d");
  const run = clock.run;
  draw.setTransform(scene.density, 0, 0, scene.density, 0, 0);
  draw.clearRect(0, 0, scene.width, scene.height);
  draw.font = `12.5px ${getComputedStyle(document.documentElement).getPropertyValue("--sans")}`;
  drawGround(draw);
  drawGoal(draw, run);
  drawTrails(draw, run);
  drawPlan(draw, run);
  drawBodies(draw, run);
  drawForce(draw, run);
  drawEdges(draw, run);
  drawNames(draw, run);
}

// What the picture shows, for the legend below it.
function writeSceneLegend() {
  const run = clock.run;
  const list = document.getElementById("scene-legend");
  list.replaceChildren();
  const dot = (colour) => (svg) =>
    element("circle", { cx: 11, cy: 6, r: 5, fill: `var(${colour})`, "fill-opacity": 0.3, stroke: `var(${colour})`, "stroke-width": 1.6 }, svg);
  const line = (colour, width, dash) => (svg) =>
    element("line", { x1: 1, y1: 6, x2: 21, y2: 6, stroke: `var(${colour})`, "stroke-width": width, "stroke-linecap": dash ? "round" : "butt", "stroke-dasharray": dash ?? "none" }, svg);
  run.involved.slice(0, 4).forEach((node) => legendEntry(list, run.nodeName[node], dot(colourName(run, node))));
  const others = run.nodes - Math.min(4, run.involved.length);
  if (others > 0) legendEntry(list, others === 1 ? "one bystander" : `${others} bystanders`, dot("--other"));
  if (run.edges.length) legendEntry(list, "believed edge", line("--belief", 4));
  if (run.contact) legendEntry(list, "true contact", line("--contact", 10));
  if (run.plan) legendEntry(list, "plan", line(colourName(run, run.plan.nodes[0] ?? 0), 3, "0.1 5"));
  if (run.controlSize >= 2) legendEntry(list, "force", line("--ink", 1.4));
}

function startScene() {
  readColours();
  const lay = () => {
    layOutScene(scene.canvas.clientWidth);
    drawScene();
  };
  redrawOnResize(scene.canvas.parentElement, lay);
  timeListeners.push(drawScene);
  runListeners.push(() => {
    writeSceneLegend();
    lay();
  });
  writeSceneLegend();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    readColours();
    drawScene();
  });
}
