"use strict";
// How measured points moved: as measured (broad arrows), as the fitted model moves (thin), and what is left between them.
const SEEN = "#f0e442", FITTED = "#4da3ff", LEFT = "#ff8ad1"; // on the slices' black, whatever the theme

// What a section's controls ask for: the kinds of data that are shown, and each arrow as [array, factor, colour, width].
Palpate.arrowsAsked = (state, section) => {
  const mode = section.querySelector(".what").value;
  const shown = state.points.filter((_, i) => { const box = section.querySelector(`[data-points="${i}"]`); return !box || box.checked; });
  return shown.map((p) => {
    if (mode === "left") {
      p.left = p.left || p.observed.map((value, i) => value - p.fitted[i]);
      return { ...p, arrows: [[p.left, state.left_factor, "left"]] };
    }
    const factor = mode === "true" ? 1 : state.motion_factor;
    return { ...p, arrows: [[p.observed, factor, "seen"], [p.fitted, factor, "fitted"]] };
  });
};

Palpate.onArrows = (section, tell) => {
  for (const input of section.querySelectorAll(".what, [data-points]")) input.addEventListener("change", tell);
  section.querySelector(".controls").hidden = false;
};

Palpate.PointSlices = class extends Palpate.Planes {
  constructor(facts, state, section) {
    super(facts, state, section, state.box);
    Palpate.onArrows(section, () => this.draw());
    for (const button of section.querySelectorAll("[data-place]")) {
      button.hidden = false;
      button.addEventListener("click", () => this.go(button.dataset.place.split(" ").map(Number)));
    }
    this.start();
  }

  volumes() { return [this.reference.background]; }

  paintPlane(context, view, frame, layers) {
    const { background, surfaces } = this.reference;
    if (background) this.drawVolume(context, view, frame, background, layers);
    for (const s of surfaces) this.stroke(context, view, frame, s, layers, { lineWidth: 2.1, dash: [0.1, 3.9] });
    for (const s of this.later.outlines) this.stroke(context, view, frame, s, layers, { lineWidth: 1.3, strokeStyle: "#fff" });
    const styles = { seen: [SEEN, 5.5], fitted: [FITTED, 2], left: [LEFT, 2.5] };
    let near = 0;
    for (const p of Palpate.arrowsAsked(this.later, this.section)) {
      const here = [];
      for (let i = 0; i < p.rest.length; i += 3) if (Math.abs(p.rest[i + view.normal] - this.position[view.normal]) <= p.near_mm) here.push(i);
      near += here.length;
      for (const [way, factor, kind] of p.arrows) {
        for (const i of here) {
          const a = p.rest[i + view.across], b = p.rest[i + view.up];
          const tip = [frame.x(a + factor * way[i + view.across]), frame.y(b + factor * way[i + view.up])];
          Palpate.flatArrow(context, [frame.x(a), frame.y(b)], tip, ...styles[kind]);
        }
      }
    }
    return `${this.reference.name}; ${near} ${near === 1 ? "point" : "points"} near`;
  }
};

// An arrow of a width in pixels; a dot where it is too short to have a head.
Palpate.flatArrow = (context, [x, y], [u, v], colour, width) => {
  const length = Math.hypot(u - x, v - y), head = Math.min(2.2 * width + 3, 0.6 * length);
  Object.assign(context, { fillStyle: colour, strokeStyle: colour, lineWidth: width, lineCap: "round" });
  context.beginPath();
  if (length < width) {
    context.arc(x, y, 0.5 * width + 0.5, 0, 2 * Math.PI);
    context.fill();
    return;
  }
  const [a, b] = [(u - x) / length, (v - y) / length], neck = [u - head * a, v - head * b], half = 0.36 * head + 0.3 * width;
  context.moveTo(x, y); context.lineTo(...neck); context.stroke();
  context.beginPath();
  context.moveTo(u, v); context.lineTo(neck[0] - half * b, neck[1] + half * a); context.lineTo(neck[0] + half * b, neck[1] - half * a);
  context.fill();
};

// The same in space, in the bodies at rest, which let them through.
Palpate.PointBodies = class {
  constructor(facts, state, section) {
    this.state = state;
    this.section = section;
    this.viewer = new Palpate.Viewer(section.querySelector(".stage"), 1);
    this.scene = this.viewer.scenes[0];
    this.clouds = [];
    for (const s of facts.references[state.reference].surfaces) {
      const geometry = Palpate.geometry(s.points, s.triangles);
      geometry.computeVertexNormals();
      const material = new THREE.MeshLambertMaterial({
        color: facts.tissues[s.tissue].colour, side: THREE.DoubleSide, transparent: true, opacity: 0.16, depthWrite: false,
      });
      this.scene.add(new THREE.Mesh(geometry, material));
      if (facts.tissues[s.tissue].role !== "rigid") this.clouds.push(s.points);
    }
    this.clouds.push(...state.points.map((p) => p.rest));
    this.radius = Palpate.ball(this.clouds).radius;
    this.arrows = new THREE.Group();
    this.scene.add(this.arrows);
    Palpate.onArrows(section, () => this.show());
    Palpate.onTheme(() => this.show());
    section.querySelector(".reset").addEventListener("click", () => this.home());
    this.show();
    this.home();
  }

  home() { this.viewer.look(this.clouds, [-1, 0.6, 0.35]); }

  show() {
    Palpate.clear(this.arrows);
    const wide = { seen: 1.7, fitted: 0.8, left: 1 };
    for (const p of Palpate.arrowsAsked(this.state, this.section)) {
      for (const [way, factor, kind] of p.arrows) {
        const places = [];
        for (let i = 0; i < p.rest.length; i += 3) {
          const along = new THREE.Vector3().fromArray(way, i).multiplyScalar(factor);
          Palpate.arrow(new THREE.Vector3().fromArray(p.rest, i), along, this.radius, places, wide[kind]);
        }
        const geometry = Palpate.geometry(new Float32Array(places)), over = kind === "fitted"; // the thin over the broad
        geometry.computeVertexNormals();
        const material = new THREE.MeshLambertMaterial({
          color: Palpate.css(`--${kind}`), side: THREE.DoubleSide, transparent: over, depthTest: !over,
        });
        const mesh = new THREE.Mesh(geometry, material);
        mesh.renderOrder = over ? 1 : 0;
        this.arrows.add(mesh);
      }
    }
    this.viewer.draw();
  }
};
