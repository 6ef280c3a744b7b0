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
// greys: brightness (0 to 255) of each step of a grey volume; colours: [r, g, b] of each number of a label volume.
Palpate.layer = (volume, view, position, greys, colours) => {
  const { origin, step, values: { shape } } = volume, jump = [shape[1] * shape[2], shape[2], 1];
  const w = shape[view.across], h = shape[view.up], n = shape[view.normal];
  const canvas = document.createElement("canvas");
  canvas.width = w; canvas.height = h;
  const context = canvas.getContext("2d"), image = context.createImageData(w, h), grey = volume.kind === "grey";
  const depth = (position - origin[view.normal]) / step[view.normal];
  const lower = Math.min(Math.max(grey ? Math.floor(depth) : Math.round(depth), 0), n - 1);
  const upper = Math.min(lower + 1, n - 1), share = grey ? Math.min(Math.max(depth - lower, 0), 1) : 0;
  const { values } = volume, { data } = image;
  for (let row = 0, at = 0; row < h; row++) {
    for (let column = 0; column < w; column++, at += 4) {
      const base = (w - 1 - column) * jump[view.across] + (h - 1 - row) * jump[view.up];
      const value = values[base + lower * jump[view.normal]];
      if (grey) {
        data[at] = data[at + 1] = data[at + 2] = greys[Math.round((1 - share) * value + share * values[base + upper * jump[view.normal]])];
      } else {
        const colour = colours[value] || colours[0];
        for (let k = 0; k < 3; k++) data[at + k] = colour[k];
      }
      data[at + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
};

// Three linked planes through a box; those who extend it say what they show: `volumes` and `paintPlane`.
Palpate.Planes = class {
  constructor(facts, later, section, box) {
    this.facts = facts;
    this.later = later;
    this.reference = facts.references[this.later.reference];
    this.section = section;
    this.box = box;
    this.position = [...box.position];
  }

  start() {
    this.figures = [...this.section.querySelectorAll(".slice-live")].map((figure, i) => this.prepare(figure, this.facts.views[i]));
    this.prepareGreys();
    new ResizeObserver(() => this.draw()).observe(this.section);
    this.draw();
  }

  prepare(figure, view) {
    const { box } = this, axis = view.normal;
    const canvas = figure.querySelector("canvas"), slider = figure.querySelector("input");
    Object.assign(slider, { min: box.low[axis], max: box.high[axis], step: 0.5, value: this.position[axis] });
    const go = (mm) => { slider.value = mm; this.position[axis] = Number(slider.value); this.draw(); };
    slider.addEventListener("input", () => go(slider.value));
    canvas.addEventListener("wheel", (event) => this.wheel(event, slider, go), { passive: false });
    canvas.style.aspectRatio = `${box.high[view.across] - box.low[view.across]} / ${box.high[view.up] - box.low[view.up]}`;
    canvas.addEventListener("pointerdown", (event) => this.point(event, view, canvas));
    canvas.addEventListener("pointermove", (event) => { if (event.buttons) this.point(event, view, canvas); });
    return { canvas, slider, view, layers: new Map() };
  }

  // The wheel goes through the slices; at the last one, and while the page is being scrolled, it scrolls the page.
  wheel(event, slider, go) {
    if (event.ctrlKey || Math.abs(event.deltaX) > Math.abs(event.deltaY) || performance.now() - Palpate.scrolled < 300) return;
    const end = event.deltaY > 0 ? slider.min : slider.max;
    if (Number(slider.value) === Number(end)) return;
    event.preventDefault();
    this.turned = (this.turned || 0) + event.deltaY * (event.deltaMode ? 40 : 1);
    const steps = Math.trunc(this.turned / 40); // mm
    if (!steps) return;
    this.turned -= 40 * steps;
    go(Number(slider.value) - Math.max(-3, Math.min(steps, 3)));
  }

  // All planes through a place, mm.
  go(place) {
    this.position = [...place];
    for (const figure of this.figures) figure.slider.value = this.position[figure.view.normal];
    this.draw();
  }

  // A click takes the two other planes through the point.
  point(event, view, canvas) {
    const { low, high } = this.box, frame = canvas.getBoundingClientRect();
    const x = Math.min(Math.max((event.clientX - frame.left) / frame.width, 0), 1);
    const y = Math.min(Math.max((event.clientY - frame.top) / frame.height, 0), 1);
    const place = [...this.position];
    place[view.across] = high[view.across] - x * (high[view.across] - low[view.across]);
    place[view.up] = high[view.up] - y * (high[view.up] - low[view.up]);
    this.go(place);
  }

  // Window and level of the grey values, where there are some: one for all images of the section.
  prepareGreys() {
    const row = this.section.querySelector(".greys"), volume = this.volumes().find((v) => v && v.kind === "grey");
    if (!row || !volume) return;
    const width = row.querySelector(".window-width"), level = row.querySelector(".window-level"), told = row.querySelector("output");
    const [least, most] = volume.span, step = volume.unit === "HU" ? 1 : (most - least) / this.facts.grey_steps;
    Object.assign(width, { min: step, max: most - least, step });
    Object.assign(level, { min: least, max: most, step });
    const set = () => {
      this.window = [Number(level.value) - Number(width.value) / 2, Number(level.value) + Number(width.value) / 2];
      const words = this.window.map((value) => Number(value.toPrecision(3))).join(" to ");
      told.textContent = `${words} ${volume.unit}`;
      width.setAttribute("aria-valuetext", told.textContent); level.setAttribute("aria-valuetext", told.textContent);
    };
    const show = ([low, high]) => { width.value = high - low; level.value = (low + high) / 2; set(); this.draw(); };
    for (const input of [width, level]) input.addEventListener("input", () => { set(); this.draw(); });
    for (const button of row.querySelectorAll("[data-window]")) {
      const [middle, wide] = button.dataset.window.split(" ").map(Number);
      button.addEventListener("click", () => show(button.dataset.window === "first" ? volume.window : [middle - wide / 2, middle + wide / 2]));
    }
    width.value = volume.window[1] - volume.window[0];
    level.value = (volume.window[0] + volume.window[1]) / 2;
    set();
  }

  greys(volume) {
    const [low, high] = this.window || volume.window, [least, most] = volume.span;
    return Uint8ClampedArray.from({ length: this.facts.grey_steps + 1 }, (_, i) => 255 * (least + (i * (most - least)) / this.facts.grey_steps - low) / (high - low));
  }

  // Dark enough for lines to stand out.
  labelColours() { return [[0, 0, 0], ...this.facts.tissues.map((t) => Palpate.rgb(t.colour).map((c) => 255 * (0.06 + 0.3 * c)))]; }

  draw() {
    for (const figure of this.figures) {
      figure.slider.setAttribute("aria-valuetext", this.place(figure.view));
      this.drawFigure(figure);
    }
  }

  // Where a plane lies, in words.
  place(view) { return `${"xyz"[view.normal]} = ${this.position[view.normal].toFixed(1)} mm`; }

  drawFigure({ canvas, view, layers }) {
    const { low, high } = this.box;
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    const scale = width / (high[view.across] - low[view.across]);
    const frame = { scale, width, height, x: (mm) => (high[view.across] - mm) * scale, y: (mm) => (high[view.up] - mm) * scale };
    context.fillStyle = "#000";
    context.fillRect(0, 0, width, height);
    this.drawFurniture(context, view, frame, this.paintPlane(context, view, frame, layers));
  }

  // A volume on a plane, from a picture that is kept until plane or greys change.
  drawVolume(context, view, frame, volume, layers) {
    const kept = layers.get(volume), key = `${this.position[view.normal]} ${volume.kind === "grey" ? this.window : this.colouring}`;
    if (!kept || kept.key !== key) {
      const grey = volume.kind === "grey";
      const picture = Palpate.layer(volume, view, this.position[view.normal], grey && this.greys(volume), !grey && this.labelColours());
      layers.set(volume, { key, picture });
    }
    context.imageSmoothingEnabled = volume.kind === "grey";
    const half = (k) => volume.step[k] / 2, last = (k) => volume.origin[k] + (volume.values.shape[k] - 1) * volume.step[k];
    const left = frame.x(last(view.across) + half(view.across)), top = frame.y(last(view.up) + half(view.up));
    const wide = volume.values.shape[view.across] * volume.step[view.across] * frame.scale;
    context.drawImage(layers.get(volume).picture, left, top, wide, volume.values.shape[view.up] * volume.step[view.up] * frame.scale);
  }

  stroke(context, view, frame, surface, layers, style) {
    const at = this.position[view.normal];
    if (!layers.has(surface) || layers.get(surface).at !== at) {
      layers.set(surface, { at, lines: Palpate.cut(surface.points, surface.triangles, view.normal, at, view.across, view.up) });
    }
    Object.assign(context, { lineJoin: "round", lineCap: "round", globalAlpha: 1, strokeStyle: this.facts.tissues[surface.tissue].colour }, style);
    context.setLineDash(style.dash || []);
    context.beginPath();
    for (const line of layers.get(surface).lines) {
      line.forEach(([a, b], i) => (i ? context.lineTo(frame.x(a), frame.y(b)) : context.moveTo(frame.x(a), frame.y(b))));
    }
    context.stroke();
    context.globalAlpha = 1;
    context.setLineDash([]);
  }

  drawFurniture(context, view, frame, title) {
    const { width, height, scale } = frame;
    const write = (text, x, y, align, font) => {
      Object.assign(context, { font, textAlign: align, textBaseline: "middle", lineWidth: 3, strokeStyle: "rgba(0,0,0,.75)", fillStyle: "#fff" });
      context.strokeText(text, x, y, width - 20);
      context.fillText(text, x, y, width - 20);
    };
    const bold = "bold 14px system-ui, sans-serif", small = "12px system-ui, sans-serif";
    context.strokeStyle = "rgba(255,255,255,.28)";
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(frame.x(this.position[view.across]), 0); context.lineTo(frame.x(this.position[view.across]), height);
    context.moveTo(0, frame.y(this.position[view.up])); context.lineTo(width, frame.y(this.position[view.up]));
    context.stroke();
    [[10, height / 2], [width - 10, height / 2], [width / 2, 30], [width / 2, height - 12]].forEach(([x, y], i) => write(view.letters[i], x, y, "center", bold));
    const bar = [50, 20, 10, 5, 1].find((mm) => mm * scale < 0.4 * width) || 1;
    context.fillStyle = "#000"; context.fillRect(13, height - 17, bar * scale + 2, 5);
    context.fillStyle = "#fff"; context.fillRect(14, height - 16, bar * scale, 3);
    write(`${bar} mm`, 14, height - 27, "left", small);
    write(this.place(view), width - 10, height - 14, "right", small);
    write(title, 10, 12, "left", small);
  }
};

// The organs' outlines over the image of one state or the other, and what the model found in colours between them.
Palpate.Slices = class extends Palpate.Planes {
  constructor(facts, number, section) {
    super(facts, facts.later[number], section, facts.references[facts.later[number].reference].slices);
    this.phase = "after";
    for (const input of section.querySelectorAll(".legend input")) input.addEventListener("change", () => this.draw());
    for (const input of section.querySelectorAll(".modes .states input")) input.addEventListener("change", () => this.flicker());
    for (const input of section.querySelectorAll(".modes .colours input")) input.addEventListener("change", () => this.colour());
    if (!facts.mesh) for (const row of section.querySelectorAll(".modes .colours")) row.hidden = true; // too large a mesh to be cut here
    this.start();
    this.colour();
  }

  volumes() { return [this.reference.background, this.later.background]; }

  get mode() { return this.section.querySelector(".modes .states input:checked").value; }

  // What is coloured: "none", "stiffness" or "motion".
  get coloured() {
    const chosen = this.facts.mesh && this.section.querySelector(".modes .colours input:checked");
    return chosen ? chosen.value : "none";
  }

  // The colours that were chosen, with their bar and their words.
  colour() {
    for (const part of this.section.querySelectorAll(".live [data-of]")) part.hidden = part.dataset.of !== this.coloured;
    this.draw();
  }

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

  paintPlane(context, view, frame, layers) {
    const shown = this.mode === "flicker" ? this.phase : this.mode;
    const image = shown === "after" ? this.later : this.reference, volume = image.background;
    if (volume) this.drawVolume(context, view, frame, volume, layers);
    const by = this.coloured;
    if (by !== "none") Palpate.drawField(context, view, frame, this, { by, moved: shown === "after" && Boolean(this.later.motion), box: this.box, layers });
    if (this.shows("after") && shown !== "before") {
      for (const s of this.later.surfaces) this.stroke(context, view, frame, s, layers, { lineWidth: 5.5, globalAlpha: 0.5 });
    }
    if (this.shows("before") && shown !== "after") {
      for (const s of this.reference.surfaces) this.stroke(context, view, frame, s, layers, { lineWidth: 2.1, dash: [0.1, 3.9] });
    }
    if (this.shows("model") && shown !== "before") {
      for (const s of this.later.outlines) this.stroke(context, view, frame, s, layers, { lineWidth: 1.3, strokeStyle: "#fff" });
    }
    return volume ? image.name : `${image.name}: no grey image given`;
  }
};
