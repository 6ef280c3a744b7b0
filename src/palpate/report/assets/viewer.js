"use strict";
// A body to turn: one canvas with one or two pictures that share the camera, orientation letters and a scale bar.
Palpate.supportsWebGL = () => {
  try {
    return Boolean(document.createElement("canvas").getContext("webgl2"));
  } catch {
    return false;
  }
};

Palpate.Viewer = class {
  constructor(frame, count) {
    this.frame = frame;
    this.canvas = frame.querySelector("canvas");
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.setScissorTest(true);
    this.camera = new THREE.OrthographicCamera(-1, 1, 1, -1, -1000, 1000);
    this.camera.up.set(0, 0, 1);
    this.scenes = Array.from({ length: count }, () => this.scene());
    this.controls = new THREE.OrbitControls(this.camera, this.canvas);
    this.controls.enableZoom = false; // the wheel scrolls the page until the picture was taken hold of
    this.controls.addEventListener("change", () => this.draw());
    this.canvas.addEventListener("pointerdown", () => { this.controls.enableZoom = true; });
    this.canvas.addEventListener("pointerleave", () => { this.controls.enableZoom = false; });
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.draw()).observe(frame);
  }

  scene() {
    const scene = new THREE.Scene();
    const lamp = new THREE.DirectionalLight(0xffffff, 1.7);
    scene.add(new THREE.AmbientLight(0xffffff, 1.25), lamp, lamp.target);
    scene.userData.lamp = lamp;
    return scene;
  }

  // Look from `back` (towards the viewer) at clouds of points, which then fill the picture.
  look(clouds, back, up = [0, 0, 1]) {
    const { centre, radius } = Palpate.ball(clouds);
    this.radius = radius;
    this.controls.target.set(...centre);
    this.camera.up.set(...up);
    this.camera.position.set(...centre).addScaledVector(new THREE.Vector3(...back).normalize(), 3 * radius);
    this.camera.near = -10 * radius; this.camera.far = 20 * radius;
    this.camera.zoom = 1;
    this.controls.update();
    this.camera.updateMatrixWorld();
    this.half = [0.7 * radius, 0.6 * radius]; // room to turn
    const point = new THREE.Vector3();
    for (const cloud of clouds) {
      for (let i = 0; i < cloud.length; i += 3) {
        point.fromArray(cloud, i).applyMatrix4(this.camera.matrixWorldInverse);
        this.half = [Math.max(this.half[0], Math.abs(point.x)), Math.max(this.half[1], Math.abs(point.y))];
      }
    }
    this.draw();
  }

  // Arrow keys turn the body by ten degrees, plus and minus bring it nearer and farther, so that it needs no mouse.
  key(event) {
    const nearer = { "+": 1.2, "=": 1.2, "-": 1 / 1.2 }[event.key];
    if (nearer && !event.ctrlKey && !event.metaKey) {
      this.camera.zoom = Math.min(Math.max(this.camera.zoom * nearer, 0.2), 20);
      this.draw();
    }
    const turn = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!turn) return;
    event.preventDefault();
    const offset = this.camera.position.clone().sub(this.controls.target), up = this.camera.up.clone().normalize();
    offset.applyAxisAngle(up, turn[0] * Math.PI / 18);
    if (turn[1]) {
      const side = up.clone().cross(offset).normalize(), before = offset.clone();
      offset.applyAxisAngle(side, -turn[1] * Math.PI / 18);
      if (Math.abs(offset.clone().normalize().dot(up)) > 0.99) offset.copy(before);
    }
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.draw();
  }

  draw() {
    if (this.pending || !this.radius) return;
    this.pending = requestAnimationFrame(() => { this.pending = 0; this.paint(); });
  }

  paint() {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight, count = this.scenes.length;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    this.renderer.setSize(width, height, false);
    const beside = width > 560, wide = beside ? width / count : width, tall = beside ? height : height / count;
    const pixel = 2.16 * Math.max(this.half[0] / wide, this.half[1] / tall);
    Object.assign(this.camera, { left: -wide * pixel / 2, right: wide * pixel / 2, top: tall * pixel / 2, bottom: -tall * pixel / 2 });
    this.camera.updateProjectionMatrix();
    this.frame.classList.toggle("beside", beside);
    this.scenes.forEach((scene, i) => {
      const x = beside ? i * wide : 0, y = beside ? 0 : (count - 1 - i) * tall;
      this.renderer.setViewport(x, y, wide, tall);
      this.renderer.setScissor(x, y, wide, tall);
      const lamp = scene.userData.lamp, side = new THREE.Vector3(-0.3, 0.4, 1).applyQuaternion(this.camera.quaternion);
      lamp.target.position.copy(this.controls.target);
      lamp.position.copy(this.controls.target).add(side);
      this.renderer.render(scene, this.camera);
    });
    this.furniture(pixel / this.camera.zoom);
  }

  furniture(pixel) {
    const bar = this.frame.querySelector(".scale-bar");
    const mm = [100, 50, 20, 10, 5, 2, 1].find((size) => size / pixel < 110) || 1;
    bar.style.width = `${mm / pixel}px`;
    bar.dataset.label = `${mm} mm`;
    const gizmo = this.frame.querySelector(".gizmo"), inverse = this.camera.quaternion.clone().invert();
    for (const [letter, axis] of [["R", [1, 0, 0]], ["L", [-1, 0, 0]], ["A", [0, 1, 0]], ["P", [0, -1, 0]], ["S", [0, 0, 1]], ["I", [0, 0, -1]]]) {
      const at = new THREE.Vector3(...axis).applyQuaternion(inverse), text = gizmo.querySelector(`[data-letter=${letter}]`);
      text.setAttribute("x", 32 + 25 * at.x);
      text.setAttribute("y", 32 - 25 * at.y);
      text.style.opacity = 0.35 + 0.65 * (at.z + 1) / 2;
      const line = gizmo.querySelector(`[data-line=${letter}]`);
      if (line) { line.setAttribute("x2", 32 + 17 * at.x); line.setAttribute("y2", 32 - 17 * at.y); }
    }
  }
};

Palpate.geometry = (points, triangles) => {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
  if (triangles) geometry.setIndex(new THREE.BufferAttribute(triangles, 1));
  return geometry;
};

Palpate.clear = (group) => {
  for (const child of [...group.children]) {
    child.geometry.dispose();
    child.material.dispose();
    group.remove(child);
  }
};

// Middle and radius of the ball around clouds of points.
Palpate.ball = (clouds) => {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const cloud of clouds) {
    for (let i = 0; i < cloud.length; i++) {
      const k = i % 3;
      if (cloud[i] < low[k]) low[k] = cloud[i];
      if (cloud[i] > high[k]) high[k] = cloud[i];
    }
  }
  const centre = low.map((value, k) => (value + high[k]) / 2);
  let radius = 1;
  for (const cloud of clouds) {
    for (let i = 0; i < cloud.length; i += 3) {
      radius = Math.max(radius, Math.hypot(cloud[i] - centre[0], cloud[i + 1] - centre[1], cloud[i + 2] - centre[2]));
    }
  }
  return { centre, radius };
};
