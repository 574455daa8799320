// From the scene to the plane of its picture, an orthographic view, and on to pixels. `axes`
// of a scene are the picture's right, its up, and the direction towards the eye.

const view = { canvas: document.getElementById("scene"), colours: {}, axes: null, toX: null, toY: null, scale: 1 };

function along(axis, point) {
  return axis[0] * point[0] + axis[1] * point[1] + axis[2] * (point[2] ?? 0);
}

// Metres in the picture.
function project(point) {
  return [along(view.axes[0], point), along(view.axes[1], point)];
}

function toPixel(point) {
  const [x, y] = project(point);
  return [view.toX(x), view.toY(y)];
}

// How near to the eye a point is, m.
function depth(point) {
  return along(view.axes[2], point);
}

// What a body takes to the right and up in the picture, from its middle, m.
function reachOf(scene, node) {
  const box = scene.box[node];
  if (!box) return [scene.radius[node] ?? 0, scene.radius[node] ?? 0];
  return [0, 1].map((side) => box.reduce((sum, length, axis) => sum + 0.5 * length * Math.abs(view.axes[side][axis]), 0));
}

// The corners of each face of a box that is turned to the eye, in pixels.
function boxFaces(middle, box) {
  const faces = [];
  for (let axis = 0; axis < 3; axis += 1) {
    const towards = view.axes[2][axis];
    if (Math.abs(towards) < 1e-9) continue;
    const corner = (first, second) => {
      const point = [0, 1, 2].map((each) => middle[each] ?? 0);
      [Math.sign(towards), first, second].forEach((sign, turn) => {
        const each = (axis + turn) % 3;
        point[each] += 0.5 * sign * (box[each] ?? 0);
      });
      return toPixel(point);
    };
    faces.push([corner(1, 1), corner(1, -1), corner(-1, -1), corner(-1, 1)]);
  }
  return faces;
}
