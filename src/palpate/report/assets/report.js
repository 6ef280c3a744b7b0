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

// The facts with their arrays, each with its shape; points come back from steps of 16 bits.
Palpate.load = async () => {
  const block = await Palpate.inflate(document.getElementById("block").textContent.trim());
  const array = ({ type, offset, shape, low, step }) => {
    let values = new TYPES[type](block, offset, shape.reduce((count, n) => count * n, 1));
    if (low) values = Float32Array.from(values, (steps, i) => low[i % 3] + step * steps);
    return Object.assign(values, { shape });
  };
  const unpacked = (key, value) => {
    if (value && value.type) return array(value);
    return value && value.table ? Palpate.scale(value) : value;
  };
  return JSON.parse(document.getElementById("facts").textContent, unpacked);
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
