// Drawing: elements, scales, ticks, lines. Text only ever enters as text, never as markup.

function element(name, attributes = {}, parent = null, text = null) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== null) node.textContent = text;
  if (parent) parent.append(node);
  return node;
}

function html(name, attributes = {}, parent = null, text = null) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== null) node.textContent = text;
  if (parent) parent.append(node);
  return node;
}

function linearScale([low, high], [from, to]) {
  return (value) => from + ((value - low) / (high - low || 1)) * (to - from);
}

function logScale([low, high], range) {
  const scale = linearScale([Math.log10(low), Math.log10(high)], range);
  return (value) => scale(Math.log10(value));
}

function niceTicks(low, high, count) {
  const rough = (high - low) / Math.max(1, count);
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= rough * 0.999);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) ticks.push(k * step + 0); // + 0: no minus zero
  return ticks;
}

// 1, 2 and 5 in every decade where there are few decades, else the decades alone.
function logTicks(low, high) {
  const factors = Math.log10(high / low) > 2.2 ? [1] : [1, 2, 5];
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power += 1) {
    for (const factor of factors) ticks.push(factor * 10 ** power);
  }
  return ticks.filter((tick) => tick >= low * 0.999 && tick <= high * 1.001);
}

function readable(value, digits = 3) {
  if (value === null || !Number.isFinite(value)) return "–";
  if (value === 0) return "0"; // also for minus zero
  if (Math.abs(value) >= 1e5 || Math.abs(value) < 1e-4) return value.toExponential(0);
  return String(Number(value.toPrecision(digits)));
}

// A line through points [x, y]; a point that is not finite leaves a gap.
function linePath(points) {
  let path = "";
  let pen = "M";
  for (const [x, y] of points) {
    if (!Number.isFinite(x) || !Number.isFinite(y)) {
      pen = "M";
      continue;
    }
    path += `${pen}${x.toFixed(1)} ${y.toFixed(1)}`;
    pen = "L";
  }
  return path;
}

// A legend entry: a little drawing made by `draw(svg)` in a 22 x 12 box, and its name.
function legendEntry(list, name, draw) {
  const entry = html("li", {}, list);
  draw(element("svg", { viewBox: "0 0 22 12", "aria-hidden": "true" }, entry));
  entry.append(name);
}

// Draw now, and again whenever the width of `parent` changes.
function redrawOnResize(parent, draw) {
  let drawn = 0;
  const redraw = () => {
    const width = Math.floor(parent.clientWidth);
    if (width > 0 && width !== drawn) {
      drawn = width;
      draw(width);
    }
  };
  redraw();
  // Not inside the observer's own call: drawing changes sizes, which it would report as an error.
  new ResizeObserver(() => requestAnimationFrame(redraw)).observe(parent);
}
