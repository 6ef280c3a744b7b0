"use strict";
// The fitted model on a slice: the tetrahedron of each pixel, coloured by Young's modulus or by the length of its motion.
const FIELD_PIXEL = 0.7, FADED = 0.15; // mm; part of the scale of displacements in which the colours fade
const ARROW_STEP = 9, LEAST_ARROW = 1.5; // mm between arrows; a shorter arrow, as it is drawn, is left out

// Which tetrahedron (-1: none) each pixel of a plane lies in, with its barycentric coordinates, four a pixel.
Palpate.cutMesh = (nodes, tets, view, position, box) => {
  const { normal, across, up } = view, { low, high } = box;
  const width = Math.ceil((high[across] - low[across]) / FIELD_PIXEL), height = Math.ceil((high[up] - low[up]) / FIELD_PIXEL);
  const tet = new Int32Array(width * height).fill(-1), shares = new Float32Array(4 * width * height);
  const b = [[], [], [], []]; // value at column 0 and row 0, then its change with each column and row
  const above = Int8Array.from({ length: nodes.length / 3 }, (_, i) => (nodes[3 * i + normal] > position ? 1 : 0));
  for (let t = 0; t < tets.length / 4; t++) {
    const sum = above[tets[4 * t]] + above[tets[4 * t + 1]] + above[tets[4 * t + 2]] + above[tets[4 * t + 3]];
    if (sum === 0 || sum === 4) continue; // most tetrahedra are not cut
    const p = [0, 1, 2, 3].map((k) => 3 * tets[4 * t + k]);
    const heights = p.map((at) => nodes[at + normal] - position);
    const e = [1, 2, 3].map((k) => [across, up, normal].map((axis) => nodes[p[k] + axis] - nodes[p[0] + axis]));
    const cross = (u, v) => [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    const faces = [cross(e[1], e[2]), cross(e[2], e[0]), cross(e[0], e[1])];
    const volume = e[0][0] * faces[0][0] + e[0][1] * faces[0][1] + e[0][2] * faces[0][2];
    if (!volume) continue;
    const from = [high[across] - FIELD_PIXEL / 2 - nodes[p[0] + across], high[up] - FIELD_PIXEL / 2 - nodes[p[0] + up], -heights[0]];
    for (let k = 0; k < 3; k++) {
      const f = faces[k].map((part) => part / volume);
      b[k + 1] = [f[0] * from[0] + f[1] * from[1] + f[2] * from[2], -FIELD_PIXEL * f[0], -FIELD_PIXEL * f[1]];
    }
    b[0] = [1 - b[1][0] - b[2][0] - b[3][0], -b[1][1] - b[2][1] - b[3][1], -b[1][2] - b[2][2] - b[3][2]];
    const range = (axis, count) => {
      const ends = p.map((at) => (high[axis] - nodes[at + axis]) / FIELD_PIXEL - 0.5);
      return [Math.max(Math.ceil(Math.min(...ends)), 0), Math.min(Math.floor(Math.max(...ends)), count - 1)];
    };
    const [left, right] = range(across, width), [top, bottom] = range(up, height);
    for (let row = top; row <= bottom; row++) {
      for (let column = left; column <= right; column++) {
        const at = row * width + column, own = b.map((part) => part[0] + column * part[1] + row * part[2]);
        if (Math.min(...own) < -1e-6) continue;
        tet[at] = t;
        shares.set(own, 4 * at);
      }
    }
  }
  return { tet, shares, width, height };
};

// The motion (three numbers) of a pixel of such a cut.
Palpate.motionAt = (cut, tets, motion, at) => {
  const found = [0, 0, 0];
  for (let k = 0; k < 4; k++) {
    for (let axis = 0; axis < 3; axis++) found[axis] += cut.shares[4 * at + k] * motion[3 * tets[4 * cut.tet[at] + k] + axis];
  }
  return found;
};

// A cut as a picture: value(pixel) in the scale's unit, NaN where nothing is coloured; below `full` of the scale it fades.
Palpate.fieldPicture = (cut, value, scale, full) => {
  const canvas = document.createElement("canvas"), colour = [0, 0, 0];
  canvas.width = cut.width; canvas.height = cut.height;
  const context = canvas.getContext("2d"), image = context.createImageData(cut.width, cut.height);
  for (let at = 0; at < cut.tet.length; at++) {
    const number = cut.tet[at] < 0 ? NaN : value(at);
    if (Number.isNaN(number)) continue;
    scale.colour(number, colour, 0);
    for (let k = 0; k < 3; k++) image.data[4 * at + k] = 255 * colour[k];
    image.data[4 * at + 3] = full ? 255 * Math.min(Math.max((number - scale.low) / (scale.high - scale.low) / full, 0), 1) : 255;
  }
  context.putImageData(image, 0, 0);
  return canvas;
};

// Colours of the model over a slice; `moved`: the model is drawn where the fitted motion has brought it.
Palpate.drawField = (context, view, frame, figure, { by, moved, box, layers }) => {
  const { facts, later } = figure, { mesh } = facts, motion = later.motion && later.motion.values;
  const at = figure.position[view.normal], key = `${by} ${moved} ${at}`;
  if (!layers.has("field") || layers.get("field").key !== key) {
    const nodes = moved ? mesh.nodes.map((place, i) => place + motion[i]) : mesh.nodes;
    const cut = Palpate.cutMesh(nodes, mesh.tets, view, at, box);
    const length = (pixel) => Math.hypot(...Palpate.motionAt(cut, mesh.tets, motion, pixel));
    const picture = by === "stiffness" ? Palpate.fieldPicture(cut, (pixel) => mesh.modulus[cut.tet[pixel]], facts.moduli, 0)
      : Palpate.fieldPicture(cut, length, later.motion.scale, FADED);
    layers.set("field", { key, cut, picture });
  }
  const { cut, picture } = layers.get("field");
  context.imageSmoothingEnabled = true;
  context.globalAlpha = 0.6;
  context.drawImage(picture, 0, 0, cut.width * FIELD_PIXEL * frame.scale, cut.height * FIELD_PIXEL * frame.scale);
  context.globalAlpha = 1;
  if (by === "motion" && !moved) Palpate.drawMotion(context, view, frame, cut, mesh.tets, later.motion, box);
};

// White arrows with a dark rim: the part of the motion that lies in the plane.
Palpate.drawMotion = (context, view, frame, cut, tets, motion, box) => {
  const step = Math.round(ARROW_STEP / FIELD_PIXEL), middle = Math.floor(step / 2), lines = [];
  for (let row = middle; row < cut.height; row += step) {
    for (let column = middle; column < cut.width; column += step) {
      const pixel = row * cut.width + column;
      if (cut.tet[pixel] < 0) continue;
      const way = Palpate.motionAt(cut, tets, motion.values, pixel);
      if (motion.factor * Math.hypot(...way) < LEAST_ARROW) continue;
      const foot = [(column + 0.5) * FIELD_PIXEL * frame.scale, (row + 0.5) * FIELD_PIXEL * frame.scale];
      const long = motion.factor * frame.scale; // pixels of a millimetre of motion
      lines.push([foot, [foot[0] - long * way[view.across], foot[1] - long * way[view.up]]]);
    }
  }
  for (const [style, lineWidth] of [["#000", 4], ["#fff", 1.8]]) {
    Object.assign(context, { strokeStyle: style, lineWidth, lineCap: "round", lineJoin: "round" });
    context.beginPath();
    for (const [[x, y], [tipX, tipY]] of lines) {
      const length = Math.hypot(tipX - x, tipY - y), head = Math.min(6, 0.5 * length);
      const angle = Math.atan2(tipY - y, tipX - x);
      context.moveTo(x, y);
      context.lineTo(tipX, tipY);
      for (const side of [-0.5, 0.5]) {
        context.moveTo(tipX, tipY);
        context.lineTo(tipX - head * Math.cos(angle + side), tipY - head * Math.sin(angle + side));
      }
    }
    context.stroke();
  }
};
