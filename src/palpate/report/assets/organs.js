"use strict";
// The model's organs before (left) and after fitting (right), coloured by their signed distance to the later image.
Palpate.Organs = class {
  constructor(facts, number, section) {
    this.facts = facts;
    this.later = facts.later[number];
    this.section = section;
    this.viewer = new Palpate.Viewer(section.querySelector(".stage"), 2);
    this.bodies = new Map();
    this.viewer.scenes.forEach((scene, i) => this.fill(scene, i === 1));
    for (const input of section.querySelectorAll("input[data-show]")) input.addEventListener("change", () => this.show());
    section.querySelector(".reset").addEventListener("click", () => this.home());
    this.show();
    this.home();
  }

  home() {
    this.viewer.look(this.later.model.flatMap((m) => [m.rest, m.fitted]), [-1, 0.3, 0.15]);
  }

  fill(scene, fitted) {
    const add = (key, mesh) => {
      scene.add(mesh);
      this.bodies.set(key, [...(this.bodies.get(key) || []), mesh]);
    };
    for (const m of this.later.model) {
      const points = fitted ? m.fitted : m.rest, distance = fitted ? m.distanceFitted : m.distanceRest;
      const colours = new Float32Array(points.length);
      distance.forEach((value, i) => this.later.scale.colour(value, colours, 3 * i));
      for (let i = 0; i < colours.length; i++) colours[i] = Math.pow(colours[i], 2.2); // three.js blends in linear light
      const geometry = Palpate.geometry(points, m.triangles);
      geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
      geometry.computeVertexNormals();
      const material = new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide });
      add(`tissue-${m.tissue}`, new THREE.Mesh(geometry, material));
    }
    for (const s of this.later.surfaces) {
      const rigid = this.facts.tissues[s.tissue].role === "rigid";
      const geometry = Palpate.geometry(s.points, s.triangles);
      geometry.computeVertexNormals();
      const material = new THREE.MeshLambertMaterial({
        color: rigid ? 0xd8d0be : 0x7d8fa8, side: THREE.DoubleSide, transparent: true, opacity: rigid ? 0.35 : 0.3, depthWrite: false,
      });
      add(rigid ? "bones" : `image-${s.tissue}`, new THREE.Mesh(geometry, material));
    }
  }

  show() {
    const on = (key) => { const input = this.section.querySelector(`input[data-show="${key}"]`); return input ? input.checked : false; };
    for (const [key, meshes] of this.bodies) {
      const image = key.startsWith("image-");
      const visible = image ? on("image") && on(key.replace("image", "tissue")) : on(key);
      for (const mesh of meshes) mesh.visible = visible;
    }
    this.viewer.draw();
  }
};
