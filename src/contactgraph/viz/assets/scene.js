// The scene as a whole on its canvas: from above in the plane, from aside in space.

function readColours() {
  const style = getComputedStyle(document.documentElement);
  const names = ["--ink", "--soft", "--faint", "--grid", "--rule", "--ground", "--bone", "--sheet", "--belief", "--contact", "--goal", "--other"];
  for (const name of [...names, "--body-0", "--body-1", "--body-2", "--body-3"]) {
    scene.colours[name] = style.getPropertyValue(name).trim();
  }
}

function drawScene() {
  const draw = scene.canvas.getContext("2d");
  const run = clock.run;
  draw.setTransform(scene.density, 0, 0, scene.density, 0, 0);
  draw.clearRect(0, 0, scene.width, scene.height);
  draw.font = `12.5px ${getComputedStyle(document.documentElement).getPropertyValue("--sans")}`;
  drawGround(draw, run);
  drawShadows(draw, run);
  drawGoal(draw, run);
  drawTrails(draw, run);
  drawSkeleton(draw, run);
  drawPlan(draw, run);
  drawBodies(draw, run);
  drawForce(draw, run);
  drawEdges(draw, run);
  drawNames(draw, run);
}

// What the picture shows, for the legend below it, and the words for scenes in space alone.
function writeSceneLegend() {
  const run = clock.run;
  scene.canvas.classList.toggle("turns", run.ground !== null);
  for (const words of document.querySelectorAll(".in-space")) words.hidden = run.dimension < 3;
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
  scene.axes = clock.run.axes;
  const lay = () => {
    layOutScene(scene.canvas.clientWidth);
    drawScene();
  };
  redrawOnResize(scene.canvas.parentElement, lay);
  timeListeners.push(drawScene);
  runListeners.push(() => {
    scene.axes = clock.run.axes;
    writeSceneLegend();
    lay();
  });
  writeSceneLegend();
  startTurning();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    readColours();
    drawScene();
  });
}
