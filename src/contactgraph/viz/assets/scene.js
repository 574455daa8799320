// The scene as a whole on its canvas: from above in the plane, from aside in space.

function readColours() {
  const style = getComputedStyle(document.documentElement);
  const names = ["--ink", "--soft", "--faint", "--grid", "--rule", "--ground", "--bone", "--sheet", "--belief", "--contact", "--goal", "--other"];
  for (const name of [...names, "--body-0", "--body-1", "--body-2", "--body-3"]) {
    view.colours[name] = style.getPropertyValue(name).trim();
  }
}

function drawScene() {
  const draw = view.canvas.getContext("2d");
  const scene = clock.scene;
  draw.setTransform(view.density, 0, 0, view.density, 0, 0);
  draw.clearRect(0, 0, view.width, view.height);
  draw.font = `12.5px ${getComputedStyle(document.documentElement).getPropertyValue("--sans")}`;
  drawGround(draw, scene);
  drawPlanes(draw, scene);
  drawShadows(draw, scene);
  drawGoal(draw, scene);
  drawTrails(draw, scene);
  drawLinks(draw, scene);
  drawPlan(draw, scene);
  drawBodies(draw, scene);
  drawForce(draw, scene);
  drawEdges(draw, scene);
  drawNames(draw, scene);
}

// What the picture shows, for the legend below it, and the words for scenes in space alone.
function writeSceneLegend() {
  const scene = clock.scene;
  view.canvas.classList.toggle("turns", scene.ground !== null);
  for (const words of document.querySelectorAll(".in-space")) words.hidden = scene.dimension < 3;
  const list = document.getElementById("scene-legend");
  list.replaceChildren();
  const dot = (colour) => (svg) =>
    element("circle", { cx: 11, cy: 6, r: 5, fill: `var(${colour})`, "fill-opacity": 0.3, stroke: `var(${colour})`, "stroke-width": 1.6 }, svg);
  const line = (colour, width, dash) => (svg) =>
    element("line", { x1: 1, y1: 6, x2: 21, y2: 6, stroke: `var(${colour})`, "stroke-width": width, "stroke-linecap": dash ? "round" : "butt", "stroke-dasharray": dash ?? "none" }, svg);
  scene.involved.slice(0, 4).forEach((node) => legendEntry(list, scene.nodeName[node], dot(colourName(scene, node))));
  const others = scene.nodes - Math.min(4, scene.involved.length);
  if (others > 0) legendEntry(list, others === 1 ? "one distractor" : `${others} distractors`, dot("--other"));
  if (scene.edges.length) legendEntry(list, "believed edge", line("--belief", 4));
  if (scene.contact) legendEntry(list, "true contact", line("--contact", 10));
  if (scene.plan) legendEntry(list, "plan", line(colourName(scene, scene.plan.nodes[0] ?? 0), 3, "0.1 5"));
  if (scene.controlSize >= 2) legendEntry(list, "force", line("--ink", 1.4));
}

function startScene() {
  readColours();
  view.axes = clock.scene.axes;
  const lay = () => {
    layOutScene(view.canvas.clientWidth);
    drawScene();
  };
  redrawOnResize(view.canvas.parentElement, lay);
  timeListeners.push(drawScene);
  sceneListeners.push(() => {
    view.axes = clock.scene.axes;
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
