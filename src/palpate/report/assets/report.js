"use strict";
// What all moving figures share: the report's facts, its arrays, colours, and the page's theme.
const Palpate = {};

Palpate.inflate = async (base64) => {
  const letters = atob(base64);
  const packed = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) packed[i] = letters.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
};

const TYPES = { uint8: Uint8Array, int16: Int16Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };

Palpate.load = async () => {
  const facts = JSON.parse(document.getElementById("facts").textContent);
  const block = await Palpate.inflate(document.getElementById("block").textContent.trim());
  const array = (entry) => new TYPES[entry.type](block, entry.offset, entry.length);
  const points = (entry) => {
    const steps = array(entry), places = new Float32Array(steps.length);
    const [x, y, z] = facts.low, step = facts.step;
    for (let i = 0; i < steps.length; i += 3) {
      places[i] = x + step * steps[i];
      places[i + 1] = y + step * steps[i + 1];
      places[i + 2] = z + step * steps[i + 2];
    }
    return places;
  };
  const surface = (entry) => ({ tissue: entry.tissue, points: points(entry.points), triangles: array(entry.triangles) });
  const volume = (entry) => entry && { ...entry, values: array(entry.values) };
  for (const reference of facts.references) {
    reference.surfaces = reference.surfaces.map(surface);
    reference.background = volume(reference.background);
  }
  for (const later of facts.later) {
    later.surfaces = later.surfaces.map(surface);
    later.background = volume(later.background);
    later.both = later.both.map(volume);
    later.outlines = later.outlines.map(surface);
    later.scale = Palpate.scale(later.scale);
    if (later.motion) {
      const { values, step, scale, factor } = later.motion;
      later.motion = { values: Float32Array.from(array(values), (steps) => step * steps), scale: Palpate.scale(scale), factor };
    }
    later.model = later.model.map((m) => ({
      tissue: m.tissue, triangles: array(m.triangles), rest: points(m.rest), fitted: points(m.fitted),
      distanceRest: array(m.distanceRest), distanceFitted: array(m.distanceFitted),
    }));
  }
  for (const state of facts.measured) {
    state.outlines = state.outlines.map(surface);
    state.points = state.points.map((p) => ({ near: p.near, rest: array(p.rest), observed: array(p.observed), fitted: array(p.fitted) }));
  }
  for (const image of facts.preview) for (const key of ["organs", "whole", "greys"]) image[key] = image[key].map(volume);
  if (facts.mesh) {
    const m = facts.mesh;
    facts.mesh = {
      nodes: points(m.nodes), tets: array(m.tets), region: array(m.region), worst: array(m.worst),
      modulus: array(m.modulus),
      strain: Float32Array.from(array(m.strain), (steps) => m.strainStep * steps), // per cent
    };
  }
  facts.angles = Palpate.scale(facts.angles);
  facts.strains = Palpate.scale(facts.strains);
  facts.moduli = facts.moduli && Palpate.scale(facts.moduli);
  return facts;
};

// A colour scale: colour(value, into, place) writes three numbers from 0 to 1; grey where there is no value.
Palpate.scale = (entry) => {
  const table = Uint8Array.from(entry.table.match(/../g), (pair) => parseInt(pair, 16));
  const along = entry.logarithmic ? Math.log : (value) => value;
  const low = along(entry.low), high = along(entry.high);
  const colour = (value, into, place) => {
    if (value === null || Number.isNaN(value)) {
      into[place] = 0.62; into[place + 1] = 0.63; into[place + 2] = 0.66;
      return;
    }
    const share = Math.min(Math.max((along(value) - low) / (high - low), 0), 1);
    const row = 3 * Math.round(255 * share);
    for (let k = 0; k < 3; k++) into[place + k] = table[row + k] / 255;
  };
  return { ...entry, colour };
};

Palpate.rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);

// Show a moving figure instead of its picture, which stays for paper.
Palpate.replace = (live, still) => {
  live.hidden = false;
  still.classList.add("replaced");
};

// A colour of the page's theme, and who must be told when it changes.
Palpate.css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
Palpate.themed = [];
Palpate.onTheme = (tell) => Palpate.themed.push(tell);

Palpate.theme = () => {
  const root = document.documentElement, button = document.getElementById("theme");
  const order = ["auto", "light", "dark"], tell = () => Palpate.themed.forEach((listener) => listener());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", tell);
  button.hidden = false;
  button.addEventListener("click", () => {
    const next = order[(order.indexOf(root.dataset.theme || "auto") + 1) % order.length];
    root.dataset.theme = next;
    button.textContent = `Theme: ${next}`;
    tell();
  });
};

// A slider that fades from one image to the other, and a button that moves it forth and back.
Palpate.play = (figure, on) => {
  clearInterval(figure.timer);
  figure.timer = 0;
  figure.button.setAttribute("aria-pressed", String(on));
  figure.button.textContent = on ? "Stop" : "Play the change";
  if (!on) return;
  const begin = performance.now() - (3000 / Math.PI) * Math.acos(1 - Number(figure.fade.value) / 50);
  figure.timer = setInterval(() => { // in three seconds, with a rest at both ends
    const phase = ((performance.now() - begin) * Math.PI) / 3000;
    figure.fade.value = 50 * (1 - Math.min(Math.max(1.3 * Math.cos(phase), -1), 1));
    figure.draw();
  }, 50);
};

Palpate.tellFade = (figure) => figure.fade.setAttribute("aria-valuetext", `${Math.round(figure.fade.value)} % of ${figure.later.name}`);

// When the page was scrolled last: a wheel that scrolls it does not stop at a figure that comes under the pointer.
Palpate.scrolled = -Infinity;
addEventListener("scroll", () => { Palpate.scrolled = performance.now(); }, { passive: true });

// Buttons that put a text of the page on the clipboard; where that is not allowed, they mark it for the reader to copy.
Palpate.copies = () => {
  for (const row of document.querySelectorAll(".copies")) {
    row.hidden = false;
    for (const button of row.querySelectorAll("[data-copy]")) {
      button.addEventListener("click", async () => {
        const source = document.getElementById(button.dataset.copy), told = row.querySelector("[role=status]");
        const folded = source.closest("details");
        if (folded) folded.open = true;
        try {
          await navigator.clipboard.writeText(source.innerText);
          told.textContent = "Copied.";
        } catch {
          getSelection().selectAllChildren(source);
          told.textContent = "Marked: copy it with Ctrl-C.";
        }
      });
    }
  }
};
