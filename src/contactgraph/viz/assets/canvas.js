// What everything on the canvas is made of; places and lengths are pixels.

function stroke(draw, points, colour, width, alpha, dash = []) {
  draw.globalAlpha = alpha;
  draw.strokeStyle = colour;
  draw.lineWidth = width;
  draw.setLineDash(dash);
  draw.beginPath();
  points.forEach(([x, y], place) => (place ? draw.lineTo(x, y) : draw.moveTo(x, y)));
  draw.stroke();
  draw.setLineDash([]);
  draw.globalAlpha = 1;
}

function disc(draw, x, y, radius, fill, alpha) {
  draw.globalAlpha = alpha;
  draw.fillStyle = fill;
  draw.beginPath();
  draw.arc(x, y, radius, 0, 2 * Math.PI);
  draw.fill();
  draw.globalAlpha = 1;
}

function ring(draw, x, y, radius, colour, width, dash = []) {
  draw.strokeStyle = colour;
  draw.lineWidth = width;
  draw.setLineDash(dash);
  draw.beginPath();
  draw.arc(x, y, radius, 0, 2 * Math.PI);
  draw.stroke();
  draw.setLineDash([]);
}

function area(draw, corners, fill, alpha) {
  draw.globalAlpha = alpha;
  draw.fillStyle = fill;
  draw.fill(new Path2D(`M${corners.map((point) => point.join(" ")).join("L")}Z`));
  draw.globalAlpha = 1;
}
