// In space, dragging the picture turns it: around the vertical, and up or down.

const TURN = 0.008; // rad a pixel
const [LEVEL, STEEP] = [0.02, 1.55]; // how far the eye may go down and up, rad

function turnedAxes([, , eye], aside, up) {
  const azimuth = Math.atan2(eye[1], eye[0]) - TURN * aside;
  const elevation = Math.max(LEVEL, Math.min(STEEP, Math.asin(eye[2]) + TURN * up));
  const [east, north] = [Math.cos(azimuth), Math.sin(azimuth)];
  const [level, raised] = [Math.cos(elevation), Math.sin(elevation)];
  return [
    [-north, east, 0],
    [-raised * east, -raised * north, level],
    [level * east, level * north, raised],
  ];
}

function startTurning() {
  const { canvas } = view;
  let last = null;
  canvas.addEventListener("pointerdown", (event) => {
    if (!clock.scene.ground) return;
    last = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!last) return;
    view.axes = turnedAxes(view.axes, event.clientX - last[0], event.clientY - last[1]);
    last = [event.clientX, event.clientY];
    fitScene(sceneBounds(clock.scene));
    drawScene();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (last = null));
}
