"use strict";
// What is known before an estimate: both images under their outlines, who is who, how middles move, and what is held.
const FACES = [0, 1, 3, 0, 3, 2, 4, 6, 7, 4, 7, 5, 0, 4, 5, 0, 5, 1, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 5, 7, 1, 7, 3];

Palpate.Preview = class extends Palpate.Planes {
  constructor(facts, number, section) {
    const later = facts.later[number], reference = facts.references[later.reference], whole = section.dataset.box === "whole";
    super(facts, later, section, whole ? facts.preview[number].view : reference.slices);
    this.own = facts.preview[number];
    this.shown = whole ? this.own.whole : this.own.organs;
    this.held = [["frame", this.own.frame, "#ffffff", []], ["field", this.own.field, "#ff6f59", [7, 5]]]
      .map(([key, points, colour, dash]) => ({ key, colour, dash, points: Float32Array.from(points.flat()), triangles: FACES }));
    this.fade = section.querySelector(".fade");
    this.button = section.querySelector(".play");
    this.fade.addEventListener("input", () => { this.play(false); this.draw(); });
    this.button.addEventListener("click", () => this.play(!this.timer));
    for (const input of section.querySelectorAll("[data-show], [data-colours]")) input.addEventListener("change", () => this.draw());
    this.start();
  }

  play(on) { Palpate.play(this, on); }

  draw() {
    Palpate.tellFade(this);
    super.draw();
  }

  volumes() { return this.own.greys; }

  on(what) { const input = this.section.querySelector(`[data-show=${what}]`); return Boolean(input && input.checked); }

  get asItLay() { return Boolean(this.own.motion) && !this.on("aligned"); }

  colour(tissue) {
    const chosen = this.section.querySelector("[data-colours]:checked");
    return !chosen || chosen.dataset.colours === "role" ? this.facts.roles[tissue.role] || tissue.colour : tissue.colour;
  }

  get colouring() { return this.colour(this.facts.tissues[0]) === this.facts.tissues[0].colour ? "tissue" : "role"; }

  labelColours() {
    const light = { void: 0.12, known: 0.2 };
    return [[0, 0, 0], ...this.facts.tissues.map((t) => Palpate.rgb(this.colour(t)).map((c) => 255 * (light[t.role] || 0.45) * c))];
  }

  // The surfaces of the later image where that lay before it was aligned.
  carried(surface) {
    if (!this.asItLay) return surface;
    this.back ||= new Map();
    if (!this.back.has(surface)) {
      const points = new Float32Array(surface.points.length), m = this.own.motion;
      for (let i = 0; i < points.length; i += 3) {
        for (let k = 0; k < 3; k++) points[i + k] = m[k][0] * surface.points[i] + m[k][1] * surface.points[i + 1] + m[k][2] * surface.points[i + 2] + m[k][3];
      }
      this.back.set(surface, { ...surface, points });
    }
    return this.back.get(surface);
  }

  paintPlane(context, view, frame, layers) {
    const share = Number(this.fade.value) / 100, second = this.asItLay ? this.shown[2] : this.shown[1];
    const greys = this.own.greys, grey = this.on("greys") && !this.asItLay;
    const paint = (volume, ground, alpha) => {
      context.globalAlpha = alpha;
      if (!alpha) return;
      if (grey && ground) {
        this.drawVolume(context, view, frame, ground, layers);
        context.globalAlpha = 0.4 * alpha;
      }
      this.drawVolume(context, view, frame, volume, layers);
      context.globalAlpha = 1;
    };
    paint(this.shown[0], greys[0], 1);
    paint(second, greys[1], share);
    for (const s of this.later.surfaces.map((s) => this.carried(s))) {
      if (this.on("after")) this.stroke(context, view, frame, s, layers, { lineWidth: 5, globalAlpha: 0.55, strokeStyle: this.colour(this.facts.tissues[s.tissue]) });
    }
    for (const s of this.reference.surfaces) {
      if (this.on("before")) this.stroke(context, view, frame, s, layers, { lineWidth: 2.1, dash: [0.1, 3.9], strokeStyle: this.colour(this.facts.tissues[s.tissue]) });
    }
    for (const box of this.held) {
      const shown = box.key === "field" ? this.carried(box) : box;
      if (this.on(box.key)) this.stroke(context, view, frame, { ...shown, tissue: 0 }, new Map(), { lineWidth: 1.6, dash: box.dash, strokeStyle: box.colour });
    }
    if (this.on("arrows")) for (const arrow of this.own.arrows) this.arrow(context, view, frame, arrow);
    if (this.on("names")) this.write(context, view, frame, layers, share);
    return share <= 0.5 ? this.reference.name : `${this.later.name}${this.asItLay ? ", as it lay" : ""}`;
  }

  // The motion of a tissue's middle as it lies in the plane, longer than it is.
  arrow(context, view, frame, [, start, end]) {
    const at = (p) => [frame.x(p[view.across]), frame.y(p[view.up])];
    const tip = start.map((value, k) => value + this.own.factor * (end[k] - value));
    const [x0, y0] = at(start), [x1, y1] = at(tip), long = Math.hypot(x1 - x0, y1 - y0);
    for (const [width, colour] of [[5, "rgba(0,0,0,.75)"], [2.2, "#fff"]]) {
      Object.assign(context, { lineWidth: width, strokeStyle: colour, fillStyle: colour, lineCap: "round" });
      context.beginPath();
      context.arc(x0, y0, width, 0, 2 * Math.PI);
      context.fill();
      if (long < 3) continue;
      const [u, v] = [(x1 - x0) / long, (y1 - y0) / long], head = Math.min(9, 0.6 * long);
      context.beginPath();
      context.moveTo(x0, y0); context.lineTo(x1, y1);
      context.moveTo(x1 - head * (u - 0.5 * v), y1 - head * (v + 0.5 * u)); context.lineTo(x1, y1);
      context.lineTo(x1 - head * (u + 0.5 * v), y1 - head * (v - 0.5 * u));
      context.stroke();
    }
  }

  // Each organ's name over the longest line of its section.
  write(context, view, frame, layers, share) {
    const surfaces = share <= 0.5 ? this.reference.surfaces : this.later.surfaces.map((s) => this.carried(s));
    for (const s of surfaces) {
      const at = this.position[view.normal];
      if (!layers.has(s) || layers.get(s).at !== at) layers.set(s, { at, lines: Palpate.cut(s.points, s.triangles, view.normal, at, view.across, view.up) });
      const line = layers.get(s).lines.reduce((best, other) => (other.length > best.length ? other : best), []);
      if (line.length < 8) continue;
      const across = line.map((p) => frame.x(p[0])), up = line.map((p) => frame.y(p[1]));
      const x = (Math.min(...across) + Math.max(...across)) / 2, y = Math.min(...up) + 14;
      Object.assign(context, { font: "600 12px system-ui, sans-serif", textAlign: "center", textBaseline: "middle", lineWidth: 3, strokeStyle: "rgba(0,0,0,.8)", fillStyle: "#fff" });
      const name = this.facts.tissues[s.tissue].name, words = name.length > 24 ? `${name.slice(0, 23)}…` : name;
      context.strokeText(words, x, y);
      context.fillText(words, x, y);
    }
  }
};
