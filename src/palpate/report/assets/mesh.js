"use strict";
// The cut tetrahedral mesh: whole tetrahedra on one side of a plane, coloured by tissue, modulus, smallest angle or strain.
const CUTS = {
  sagittal: { axis: 0, back: [-1, 0.3, 0.22], up: [0, 0, 1], keep: 1 },
  coronal: { axis: 1, back: [-0.25, 1, 0.25], up: [0, 0, 1], keep: -1 },
  axial: { axis: 2, back: [-0.12, -0.3, -1], up: [0, 1, 0], keep: 1 },
};

Palpate.Mesh = class {
  constructor(facts, section) {
    this.facts = facts;
    this.mesh = facts.mesh;
    this.section = section;
    this.findFaces();
    this.viewer = new Palpate.Viewer(section.querySelector(".stage"), 1);
    this.group = new THREE.Group();
    this.viewer.scenes[0].add(this.group);
    this.slider = section.querySelector(".cut-position");
    this.slider.addEventListener("input", () => this.build());
    for (const input of section.querySelectorAll("input[name=cut]")) input.addEventListener("change", () => this.turnTo());
    for (const input of section.querySelectorAll("input[name=colouring], input[data-show]")) input.addEventListener("change", () => this.build());
    section.querySelector(".reset").addEventListener("click", () => this.turnTo());
    this.turnTo();
  }

  // Every face once, with the tetrahedra on its two sides; its first corners are wound as seen from the first of them.
  findFaces() {
    const { tets, nodes } = this.mesh, count = tets.length / 4, sides = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];
    const known = new Map(), n = nodes.length / 3, corners = [], first = [], second = [];
    for (let t = 0; t < count; t++) {
      for (const side of sides) {
        const [a, b, c] = side.map((k) => tets[4 * t + k]);
        const low = Math.min(a, b, c), high = Math.max(a, b, c);
        const key = (low * n + (a + b + c - low - high)) * n + high;
        const face = known.get(key);
        if (face === undefined) {
          known.set(key, first.length);
          corners.push(a, b, c); first.push(t); second.push(-1);
        } else {
          second[face] = t;
          known.delete(key);
        }
      }
    }
    this.faces = { corners: Uint32Array.from(corners), first: Int32Array.from(first), second: Int32Array.from(second) };
    this.middles = new Float32Array(3 * count);
    for (let t = 0; t < count; t++) {
      for (let k = 0; k < 3; k++) {
        let sum = 0;
        for (let j = 0; j < 4; j++) sum += nodes[3 * tets[4 * t + j] + k];
        this.middles[3 * t + k] = sum / 4;
      }
    }
  }

  chosen(name) { return this.section.querySelector(`input[name=${name}]:checked`).value; }

  turnTo() {
    const cut = CUTS[this.chosen("cut")], { centre } = Palpate.ball([this.mesh.nodes]);
    let low = Infinity, high = -Infinity;
    for (let i = cut.axis; i < this.mesh.nodes.length; i += 3) {
      low = Math.min(low, this.mesh.nodes[i]); high = Math.max(high, this.mesh.nodes[i]);
    }
    const box = this.facts.references.length ? this.facts.references[0].slices : null;
    const start = box ? box.position[cut.axis] : centre[cut.axis];
    Object.assign(this.slider, { min: low, max: high, step: 0.5, value: start });
    this.build();
    this.viewer.look([this.mesh.nodes], cut.back, cut.up);
  }

  kept() {
    const cut = CUTS[this.chosen("cut")], at = Number(this.slider.value), { region } = this.mesh;
    const shown = this.facts.tissues.map((_, i) => {
      const input = this.section.querySelector(`input[data-show="tissue-${i}"]`);
      return !input || input.checked;
    });
    const kept = new Uint8Array(region.length);
    for (let t = 0; t < region.length; t++) {
      kept[t] = shown[region[t]] && cut.keep * (this.middles[3 * t + cut.axis] - at) > 0 ? 1 : 0;
    }
    const words = `${"xyz"[cut.axis]} = ${at.toFixed(1)} mm`;
    this.section.querySelector(".cut-value").textContent = words;
    this.slider.setAttribute("aria-valuetext", words);
    return kept;
  }

  palette() {
    const by = this.chosen("colouring"), { tissues, moduli, angles, strains } = this.facts, { region, worst, strain } = this.mesh;
    const colours = tissues.map((tissue) => {
      const colour = by === "modulus" ? [0, 0, 0] : Palpate.rgb(tissue.colour);
      if (by === "modulus") moduli.colour(tissue.modulus, colour, 0);
      return colour;
    });
    const own = { angle: [angles, worst], strain: [strains, strain] }[by]; // scale and values of each tetrahedron
    if (!own) return (tet) => colours[region[tet]];
    const [scale, values] = own, shade = [0, 0, 0];
    return (tet) => {
      scale.colour(values[tet], shade, 0);
      return shade;
    };
  }

  build() {
    const { corners, first, second } = this.faces, { nodes } = this.mesh, kept = this.kept(), colour = this.palette();
    const places = [], colours = [], lines = [];
    for (let f = 0; f < first.length; f++) {
      const a = kept[first[f]], b = second[f] >= 0 && kept[second[f]];
      if (Boolean(a) === Boolean(b)) continue;
      const shade = colour(a ? first[f] : second[f]);
      for (let k = 0; k < 3; k++) {
        const node = corners[3 * f + k], other = corners[3 * f + (k + 1) % 3];
        for (let i = 0; i < 3; i++) { places.push(nodes[3 * node + i]); colours.push(Math.pow(shade[i], 2.2)); }
        if (node < other || b === false || second[f] < 0) {
          for (const end of [node, other]) lines.push(nodes[3 * end], nodes[3 * end + 1], nodes[3 * end + 2]);
        }
      }
    }
    Palpate.clear(this.group);
    const geometry = Palpate.geometry(new Float32Array(places));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(colours), 3));
    geometry.computeVertexNormals();
    const material = new THREE.MeshLambertMaterial({
      vertexColors: true, side: THREE.DoubleSide, flatShading: true, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1,
    });
    const edges = new THREE.LineBasicMaterial({ color: 0x0b0e12, transparent: true, opacity: 0.55 });
    this.group.add(new THREE.Mesh(geometry, material), new THREE.LineSegments(Palpate.geometry(new Float32Array(lines)), edges));
    for (const bar of this.section.querySelectorAll(".live [data-bar]")) bar.hidden = bar.dataset.bar !== this.chosen("colouring");
    this.viewer.draw();
  }
};
