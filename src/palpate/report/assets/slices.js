"use strict";
// Three linked slices through the volume: the grey image under the contours, which are cut from the surfaces here.
Palpate.cut = (points, triangles, axis, position, across, up) => {
  const next = new Map(); // edge of the triangulation -> the segments that end on it
  const segments = [];
  const count = points.length / 3;
  const place = new Map();
  const end = (a, b, ha, hb) => {
    if (a > b) { [a, b] = [b, a]; [ha, hb] = [hb, ha]; }
    const key = a * count + b;
    if (!place.has(key)) {
      const share = ha / (ha - hb);
      const at = (k) => points[3 * a + k] + share * (points[3 * b + k] - points[3 * a + k]);
      place.set(key, [at(across), at(up)]);
    }
    return key;
  };
  for (let t = 0; t < triangles.length; t += 3) {
    const a = points[3 * triangles[t] + axis] > position, b = points[3 * triangles[t + 1] + axis] > position;
    if (a === b && b === points[3 * triangles[t + 2] + axis] > position) continue; // most triangles are not cut
    const corner = [triangles[t], triangles[t + 1], triangles[t + 2]];
    const height = corner.map((i) => points[3 * i + axis] - position || -1e-6);
    const keys = [];
    for (let k = 0; k < 3; k++) {
      const j = (k + 1) % 3;
      if ((height[k] > 0) !== (height[j] > 0)) keys.push(end(corner[k], corner[j], height[k], height[j]));
    }
    if (keys.length !== 2) continue;
    for (const key of keys) {
      if (!next.has(key)) next.set(key, []);
      next.get(key).push(segments.length);
    }
    segments.push(keys);
  }
  return Palpate.join(segments, next, place);
};

// Lines as long as they go, so that dots along them keep their rhythm.
Palpate.join = (segments, next, place) => {
  const used = new Uint8Array(segments.length), lines = [];
  const follow = (first) => {
    let [start, end] = segments[first];
    if (next.get(end).length === 1) [start, end] = [end, start];
    const line = [place.get(start), place.get(end)];
    used[first] = 1;
    for (;;) {
      const number = next.get(end).find((n) => !used[n]);
      if (number === undefined) break;
      used[number] = 1;
      end = segments[number][0] === end ? segments[number][1] : segments[number][0];
      line.push(place.get(end));
    }
    lines.push(line);
  };
  for (const ends of next.values()) if (ends.length === 1 && !used[ends[0]]) follow(ends[0]);
  for (let n = 0; n < segments.length; n++) if (!used[n]) follow(n);
  return lines;
};

// One slice of a volume as a picture of its own pixels; grey values between two layers are blended.
Palpate.layer = (volume, view, position, tissues) => {
  const [nx, ny, nz] = volume.shape, size = [nx, ny, nz], jump = [ny * nz, nz, 1];
  const w = size[view.across], h = size[view.up], n = size[view.normal];
  const canvas = document.createElement("canvas");
  canvas.width = w; canvas.height = h;
  const context = canvas.getContext("2d"), image = context.createImageData(w, h);
  const depth = (position - volume.origin[view.normal]) / volume.step[view.normal];
  const grey = volume.kind === "grey";
  const lower = Math.min(Math.max(grey ? Math.floor(depth) : Math.round(depth), 0), n - 1);
  const upper = Math.min(lower + 1, n - 1), share = grey ? Math.min(Math.max(depth - lower, 0), 1) : 0;
  const colours = [[0, 0, 0], ...tissues.map((t) => Palpate.rgb(t.colour).map((c) => 255 * (0.06 + 0.3 * c)))];
  for (let row = 0; row < h; row++) {
    for (let column = 0; column < w; column++) {
      const base = (w - 1 - column) * jump[view.across] + (h - 1 - row) * jump[view.up];
      const value = volume.values[base + lower * jump[view.normal]];
      const shown = grey ? (1 - share) * value + share * volume.values[base + upper * jump[view.normal]] : value;
      const colour = grey ? [shown, shown, shown] : colours[shown] || colours[0];
      image.data.set([...colour, 255], 4 * (row * w + column));
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
};

Palpate.Slices = class {
  constructor(facts, number, section) {
    this.facts = facts;
    this.later = facts.later[number];
    this.reference = facts.references[this.later.reference];
    this.section = section;
    this.position = [...this.reference.box.position];
    this.phase = "after";
    this.figures = [...section.querySelectorAll(".slice-live")].map((figure, i) => this.prepare(figure, facts.views[i]));
    for (const input of section.querySelectorAll(".legend input")) input.addEventListener("change", () => this.draw());
    for (const input of section.querySelectorAll(".modes input")) input.addEventListener("change", () => this.flicker());
    new ResizeObserver(() => this.draw()).observe(section);
    this.draw();
  }

  prepare(figure, view) {
    const { box } = this.reference, axis = view.normal;
    const canvas = figure.querySelector("canvas"), slider = figure.querySelector("input");
    Object.assign(slider, { min: box.low[axis], max: box.high[axis], step: 0.5, value: this.position[axis] });
    slider.addEventListener("input", () => { this.position[axis] = Number(slider.value); this.draw(); });
    canvas.style.aspectRatio = `${box.high[view.across] - box.low[view.across]} / ${box.high[view.up] - box.low[view.up]}`;
    canvas.addEventListener("pointerdown", (event) => this.point(event, view, canvas));
    canvas.addEventListener("pointermove", (event) => { if (event.buttons) this.point(event, view, canvas); });
    return { canvas, slider, view, layers: new Map() };
  }

  // A click takes the two other planes through the point.
  point(event, view, canvas) {
    const { low, high } = this.reference.box, frame = canvas.getBoundingClientRect();
    const x = Math.min(Math.max((event.clientX - frame.left) / frame.width, 0), 1);
    const y = Math.min(Math.max((event.clientY - frame.top) / frame.height, 0), 1);
    this.position[view.across] = high[view.across] - x * (high[view.across] - low[view.across]);
    this.position[view.up] = high[view.up] - y * (high[view.up] - low[view.up]);
    for (const figure of this.figures) figure.slider.value = this.position[figure.view.normal];
    this.draw();
  }

  get mode() { return this.section.querySelector(".modes input:checked").value; }

  shows(layer) { return this.section.querySelector(`.t-${layer}`).checked; }

  flicker() {
    clearInterval(this.timer);
    if (this.mode === "flicker") {
      this.timer = setInterval(() => {
        this.phase = this.phase === "after" ? "before" : "after";
        this.draw();
      }, 700);
    }
    this.draw();
  }

  draw() {
    const shown = this.mode === "flicker" ? this.phase : this.mode;
    for (const figure of this.figures) this.drawFigure(figure, shown);
  }

  drawFigure({ canvas, view, layers }, shown) {
    const { low, high } = this.reference.box;
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    const scale = width / (high[view.across] - low[view.across]);
    const frame = { scale, width, height, x: (mm) => (high[view.across] - mm) * scale, y: (mm) => (high[view.up] - mm) * scale };
    this.drawImage(context, view, frame, shown, layers);
    this.drawContours(context, view, frame, shown);
    this.drawFurniture(context, view, frame, shown);
  }

  drawImage(context, view, frame, shown, layers) {
    const volume = (shown === "after" && this.later.background) || this.reference.background;
    context.fillStyle = "#000";
    context.fillRect(0, 0, frame.width, frame.height);
    if (!volume) return;
    const key = `${volume === this.reference.background} ${this.position[view.normal]}`;
    if (layers.get("key") !== key) {
      layers.set("key", key);
      layers.set("picture", Palpate.layer(volume, view, this.position[view.normal], this.facts.tissues));
    }
    context.imageSmoothingEnabled = volume.kind === "grey";
    const half = (k) => volume.step[k] / 2, last = (k) => volume.origin[k] + (volume.shape[k] - 1) * volume.step[k];
    const left = frame.x(last(view.across) + half(view.across)), top = frame.y(last(view.up) + half(view.up));
    const wide = volume.shape[view.across] * volume.step[view.across] * frame.scale;
    context.drawImage(layers.get("picture"), left, top, wide, volume.shape[view.up] * volume.step[view.up] * frame.scale);
  }

  drawContours(context, view, frame, shown) {
    const at = this.position[view.normal];
    const stroke = (points, triangles, style) => {
      Object.assign(context, { lineJoin: "round", lineCap: "round", globalAlpha: 1 }, style);
      context.setLineDash(style.dash || []);
      context.beginPath();
      for (const line of Palpate.cut(points, triangles, view.normal, at, view.across, view.up)) {
        line.forEach(([a, b], i) => (i ? context.lineTo(frame.x(a), frame.y(b)) : context.moveTo(frame.x(a), frame.y(b))));
      }
      context.stroke();
    };
    const colour = (surface) => this.facts.tissues[surface.tissue].colour;
    if (this.shows("after") && shown !== "before") {
      for (const s of this.later.surfaces) stroke(s.points, s.triangles, { strokeStyle: colour(s), lineWidth: 5.5, globalAlpha: 0.5 });
    }
    if (this.shows("before") && shown !== "after") {
      for (const s of this.reference.surfaces) stroke(s.points, s.triangles, { strokeStyle: colour(s), lineWidth: 2.1, dash: [0.1, 3.9] });
    }
    if (this.shows("model") && this.later.model.length) {
      for (const m of this.later.model) {
        stroke(shown === "before" ? m.rest : m.fitted, m.triangles, { strokeStyle: "#fff", lineWidth: 1.3 });
      }
    }
    context.globalAlpha = 1;
    context.setLineDash([]);
  }

  drawFurniture(context, view, frame, shown) {
    const { width, height, scale } = frame;
    const write = (text, x, y, align, font) => {
      Object.assign(context, { font, textAlign: align, textBaseline: "middle", lineWidth: 3, strokeStyle: "rgba(0,0,0,.75)", fillStyle: "#fff" });
      context.strokeText(text, x, y);
      context.fillText(text, x, y);
    };
    const bold = "bold 14px system-ui, sans-serif", small = "12px system-ui, sans-serif";
    context.strokeStyle = "rgba(255,255,255,.28)";
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(frame.x(this.position[view.across]), 0); context.lineTo(frame.x(this.position[view.across]), height);
    context.moveTo(0, frame.y(this.position[view.up])); context.lineTo(width, frame.y(this.position[view.up]));
    context.stroke();
    [[10, height / 2], [width - 10, height / 2], [width / 2, 12], [width / 2, height - 12]].forEach(([x, y], i) => write(view.letters[i], x, y, "center", bold));
    const bar = [50, 20, 10, 5, 1].find((mm) => mm * scale < 0.4 * width) || 1;
    context.fillStyle = "#000"; context.fillRect(13, height - 17, bar * scale + 2, 5);
    context.fillStyle = "#fff"; context.fillRect(14, height - 16, bar * scale, 3);
    write(`${bar} mm`, 14, height - 27, "left", small);
    write(`${"xyz"[view.normal]} = ${this.position[view.normal].toFixed(1)} mm`, width - 10, height - 14, "right", small);
    if (shown !== "overlay") write(shown === "before" ? "earlier image" : "later image", 12, 14, "left", small);
  }
};
