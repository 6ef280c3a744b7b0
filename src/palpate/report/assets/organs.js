"use strict";
// The model's organs as in the earlier image (first) and on their way to the fitted state (second), coloured by their
// signed distance to the later image; that image as level lines; arrows of the motion.
const LEVELS_MM = 3, MOST_ARROWS = 350, SIDES = 6;

Palpate.Organs = class {
  constructor(facts, number, section) {
    this.facts = facts;
    this.later = facts.later[number];
    this.section = section;
    this.viewer = new Palpate.Viewer(section.querySelector(".stage"), 2);
    this.bodies = new Map();
    this.moving = [];
    this.viewer.scenes.forEach((scene, i) => this.fill(scene, i === 1));
    this.arrows = this.viewer.scenes.map((scene) => { const group = new THREE.Group(); scene.add(group); return group; });
    this.slider = section.querySelector(".motion");
    this.slider.addEventListener("input", () => this.move());
    section.querySelector(".arrows").addEventListener("change", () => this.show());
    for (const input of section.querySelectorAll("input[data-show]")) input.addEventListener("change", () => this.show());
    section.querySelector(".reset").addEventListener("click", () => this.home());
    Palpate.onTheme(() => this.show());
    this.move();
    this.show();
    this.home();
  }

  home() {
    this.viewer.look(this.later.model.flatMap((m) => [m.rest, m.fitted]), [-1, 0.3, 0.15]);
  }

  add(scene, key, mesh) {
    scene.add(mesh);
    this.bodies.set(key, [...(this.bodies.get(key) || []), mesh]);
  }

  fill(scene, moving) {
    for (const m of this.later.model) {
      const geometry = Palpate.geometry(Float32Array.from(m.rest), m.triangles);
      geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(m.rest.length), 3));
      this.paint(geometry, m, 0);
      if (moving) this.moving.push([geometry, m]);
      const material = new THREE.MeshLambertMaterial({
        vertexColors: true, side: THREE.DoubleSide, polygonOffsetFactor: 1, polygonOffsetUnits: 1,
      });
      this.add(scene, `tissue-${m.tissue}`, new THREE.Mesh(geometry, material));
    }
    for (const s of this.later.surfaces) {
      if (this.facts.tissues[s.tissue].role === "rigid") {
        const geometry = Palpate.geometry(s.points, s.triangles);
        geometry.computeVertexNormals();
        const material = new THREE.MeshLambertMaterial({ color: 0xd8d0be, side: THREE.DoubleSide, transparent: true, opacity: 0.35, depthWrite: false });
        this.add(scene, "bones", new THREE.Mesh(geometry, material));
      } else {
        this.add(scene, `image-${s.tissue}`, new THREE.LineSegments(Palpate.geometry(this.levels(s)), new THREE.LineBasicMaterial()));
      }
    }
  }

  // Lines where horizontal planes cut a surface: they let the model's colours through, and vanish where it stands out.
  levels(surface) {
    if (surface.levels) return surface.levels;
    let low = Infinity, high = -Infinity;
    for (let i = 2; i < surface.points.length; i += 3) { low = Math.min(low, surface.points[i]); high = Math.max(high, surface.points[i]); }
    const ends = [];
    for (let z = Math.ceil(low / LEVELS_MM) * LEVELS_MM; z < high; z += LEVELS_MM) {
      for (const line of Palpate.cut(surface.points, surface.triangles, 2, z, 0, 1)) {
        for (let i = 1; i < line.length; i++) ends.push(...line[i - 1], z, ...line[i], z);
      }
    }
    surface.levels = new Float32Array(ends);
    return surface.levels;
  }

  // Points and colours of a body after a share of the motion; in between, the distances of both ends are mixed.
  paint(geometry, m, share) {
    const places = geometry.attributes.position.array, colours = geometry.attributes.color.array;
    for (let i = 0; i < places.length; i++) places[i] = m.rest[i] + share * (m.fitted[i] - m.rest[i]);
    for (let i = 0; i < m.distance_rest.length; i++) {
      this.later.scale.colour((1 - share) * m.distance_rest[i] + share * m.distance_fitted[i], colours, 3 * i);
    }
    for (let i = 0; i < colours.length; i++) colours[i] = Math.pow(colours[i], 2.2); // three.js blends in linear light
    geometry.attributes.position.needsUpdate = geometry.attributes.color.needsUpdate = true;
    geometry.computeVertexNormals();
  }

  move() {
    for (const [geometry, m] of this.moving) this.paint(geometry, m, Number(this.slider.value) / 100);
    const words = `${this.slider.value} % of the motion`;
    this.section.querySelector(".motion ~ .cut-value").textContent = words;
    this.slider.setAttribute("aria-valuetext", words);
    const title = this.section.querySelectorAll(".halves span")[1];
    this.fitted = this.fitted || title.textContent;
    title.textContent = this.slider.value === "100" ? this.fitted : `${words} to ${this.later.name}`;
    this.viewer.draw();
  }

  on(key) { const input = this.section.querySelector(`input[data-show="${key}"]`); return input ? input.checked : false; }

  show() {
    const longer = Number(this.section.querySelector(".arrows").value), colour = Palpate.css("--mark");
    for (const [key, meshes] of this.bodies) {
      const image = key.startsWith("image-");
      const visible = image ? this.on("image") && this.on(key.replace("image", "tissue")) : this.on(key);
      for (const mesh of meshes) {
        mesh.visible = visible;
        if (image) mesh.material.color.set(colour);
        if (!key.startsWith("tissue-")) continue;
        Object.assign(mesh.material, { polygonOffset: this.on("image"), transparent: longer > 0, opacity: longer ? 0.45 : 1, depthWrite: !longer });
        mesh.material.needsUpdate = true;
      }
    }
    for (const group of this.arrows) {
      Palpate.clear(group);
      if (longer) group.add(new THREE.Mesh(this.arrowsOf(longer), new THREE.MeshLambertMaterial({ color: Palpate.css("--arrow"), side: THREE.DoubleSide })));
    }
    this.viewer.draw();
  }

  // Arrows from where a point is in the earlier image to where the fit takes it, of points spread evenly.
  arrowsOf(longer) {
    const shown = this.later.model.filter((m) => this.on(`tissue-${m.tissue}`));
    const { radius } = Palpate.ball(this.later.model.map((m) => m.rest));
    const places = [], cell = radius / Math.sqrt(MOST_ARROWS / 12), taken = new Set();
    for (const m of shown) {
      for (let i = 0; i < m.rest.length; i += 3) {
        const key = [m.tissue, ...[0, 1, 2].map((k) => Math.floor(m.rest[i + k] / cell))].join();
        if (taken.has(key)) continue;
        taken.add(key);
        const from = new THREE.Vector3().fromArray(m.rest, i);
        Palpate.arrow(from, new THREE.Vector3().fromArray(m.fitted, i).sub(from).multiplyScalar(longer), radius, places);
      }
    }
    const geometry = Palpate.geometry(new Float32Array(places));
    geometry.computeVertexNormals();
    return geometry;
  }
};

// Triangles of an arrow along `way` (mm), as thick as suits a body of that radius, or `wide` times that; none for what is
// too short to be seen.
Palpate.arrow = (from, way, radius, places, wide = 1) => {
  const length = way.length();
  if (length < 0.004 * radius) return;
  const along = way.clone().normalize(), side = new THREE.Vector3(Math.abs(along.x) < 0.8 ? 1 : 0, Math.abs(along.x) < 0.8 ? 0 : 1, 0);
  const u = side.cross(along).normalize(), v = along.clone().cross(u), head = Math.min(0.05 * radius, 0.6 * length);
  const ring = (thick, up) => Array.from({ length: SIDES }, (_, i) => from.clone().addScaledVector(along, up)
    .addScaledVector(u, thick * Math.cos((2 * Math.PI * i) / SIDES)).addScaledVector(v, thick * Math.sin((2 * Math.PI * i) / SIDES)));
  const thick = 0.18 * wide * head, foot = ring(thick, 0), neck = ring(thick, length - head), brim = ring(0.42 * wide * head, length - head);
  const tip = from.clone().add(way), face = (...corners) => { for (const corner of corners) places.push(corner.x, corner.y, corner.z); };
  for (let i = 0; i < SIDES; i++) {
    const j = (i + 1) % SIDES;
    face(foot[i], foot[j], neck[j]); face(foot[i], neck[j], neck[i]);
    face(brim[i], brim[j], tip); face(neck[i], neck[j], brim[j]); face(neck[i], brim[j], brim[i]);
  }
};
