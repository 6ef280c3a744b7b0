"use strict";
// A button at each figure that saves it: what is drawn in lines as SVG, what is made of pixels as PNG; no network.
Palpate.saveFile = (blob, name) => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
};

// The title of a figure: its caption, or the words that stand for its canvas.
Palpate.titleOf = (figure) => {
  const caption = figure.querySelector("figcaption");
  return caption ? caption.firstChild.textContent : figure.querySelector("canvas").getAttribute("aria-label").split(";")[0];
};

// Case, heading and title of a figure as the name of a file.
Palpate.fileName = (figure, ending) => {
  const heading = figure.closest("section").querySelector("h2");
  const words = [document.querySelector("h1").textContent, heading ? heading.textContent : "", Palpate.titleOf(figure)];
  return `${words.join(" ").normalize("NFKD").replace(/[^A-Za-z0-9]+/g, "-").replace(/^-|-$/g, "").toLowerCase().slice(0, 100)}.${ending}`;
};

// A figure in lines stands alone: black on white, or on the black of slices, in the size that it has on the page.
Palpate.svgFile = (svg) => {
  const copy = svg.cloneNode(true), box = svg.viewBox.baseVal;
  copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  copy.setAttribute("width", `${box.width}pt`);
  copy.setAttribute("height", `${box.height}pt`);
  copy.setAttribute("style", `color:#000;background:${svg.closest(".slice") ? "#000" : "#fff"}`);
  return new Blob([new XMLSerializer().serializeToString(copy)], { type: "image/svg+xml" });
};

// Colour bars beside a figure that can be seen: their colours, ticks and words.
Palpate.barsOf = (figure) => [...figure.closest("section").querySelectorAll(".colour-bar")].filter((bar) => bar.checkVisibility()).map((bar) => ({
  colours: getComputedStyle(bar.querySelector(".ramp")).backgroundImage.match(/rgb\([^)]*\)/g) || [],
  ticks: [...bar.querySelectorAll(".ticks span")].map((tick) => [parseFloat(tick.style.left) / 100, tick.textContent]),
  label: bar.querySelector(".bar-label").textContent,
}));

// A picture of pixels with its title above and its colour bars below, on white.
Palpate.pngFile = (canvas, title, bars, done) => {
  const width = Math.max(canvas.width, 480), unit = width / 480, bar = 52 * unit, top = 24 * unit;
  const sheet = document.createElement("canvas"), context = sheet.getContext("2d");
  sheet.width = width;
  sheet.height = Math.ceil(top + canvas.height + bars.length * bar);
  context.fillStyle = "#fff";
  context.fillRect(0, 0, sheet.width, sheet.height);
  const write = (text, x, y, align, size) => {
    Object.assign(context, { fillStyle: "#000", textAlign: align, textBaseline: "middle", font: `${size * unit}px system-ui, sans-serif` });
    context.fillText(text, x, y, width);
  };
  write(title, 4 * unit, top / 2, "left", 13);
  context.drawImage(canvas, (width - canvas.width) / 2, top);
  bars.forEach(({ colours, ticks, label }, number) => {
    const y = top + canvas.height + number * bar, left = 20 * unit, long = width - 40 * unit;
    const ramp = context.createLinearGradient(left, 0, left + long, 0);
    colours.forEach((colour, i) => ramp.addColorStop(i / Math.max(colours.length - 1, 1), colour));
    context.fillStyle = ramp;
    context.fillRect(left, y + 8 * unit, long, 10 * unit);
    for (const [place, text] of ticks) {
      context.fillStyle = "#000";
      context.fillRect(left + place * long - 0.5 * unit, y + 6 * unit, unit, 14 * unit);
      write(text, left + place * long, y + 27 * unit, place < 0.05 ? "left" : place > 0.95 ? "right" : "center", 10);
    }
    write(label, width / 2, y + 42 * unit, "center", 11);
  });
  sheet.toBlob(done, "image/png");
};

// The picture in an element <img>, which a canvas can take.
Palpate.canvasOf = (image) => {
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
  canvas.getContext("2d").drawImage(image, 0, 0);
  return canvas;
};

// What is drawn now, on white, with the bar of millimetres that lies over it.
Palpate.sheetOf = (figure) => {
  const canvas = figure.querySelector("canvas"), source = canvas || Palpate.canvasOf(figure.querySelector("img"));
  const sheet = document.createElement("canvas"), context = sheet.getContext("2d"), bar = figure.querySelector(".scale-bar");
  sheet.width = source.width; sheet.height = source.height;
  context.fillStyle = "#fff";
  context.fillRect(0, 0, sheet.width, sheet.height);
  context.drawImage(source, 0, 0);
  if (bar) {
    const ratio = canvas.width / canvas.clientWidth;
    Object.assign(context, { fillStyle: "#000", font: `${12 * ratio}px system-ui, sans-serif`, textBaseline: "bottom" });
    context.fillRect(14 * ratio, sheet.height - 16 * ratio, bar.offsetWidth * ratio, 4 * ratio);
    context.fillText(bar.dataset.label, 14 * ratio, sheet.height - 20 * ratio);
  }
  return sheet;
};

Palpate.lines = (figure) => figure.querySelector(":scope > svg:not(.gizmo)");

Palpate.saveFigure = (figure) => {
  const svg = Palpate.lines(figure);
  if (svg) return Palpate.saveFile(Palpate.svgFile(svg), Palpate.fileName(figure, "svg"));
  const halves = [...figure.querySelectorAll(".halves span")].map((half) => half.textContent).join(" | ");
  const keep = (blob) => Palpate.saveFile(blob, Palpate.fileName(figure, "png"));
  Palpate.pngFile(Palpate.sheetOf(figure), halves || Palpate.titleOf(figure), Palpate.barsOf(figure), keep);
};

// One button a figure; a figure without a picture, of which a sentence tells why, has none.
Palpate.saves = () => {
  for (const figure of document.querySelectorAll("main figure, main .stage")) {
    const kind = Palpate.lines(figure) ? "SVG" : "PNG";
    if (kind === "PNG" && !figure.querySelector("canvas, img")) continue;
    const button = document.createElement("button");
    Object.assign(button, { type: "button", className: "save", textContent: `Save ${kind}` });
    button.setAttribute("aria-label", `Save ${kind}: ${Palpate.titleOf(figure)}`);
    button.addEventListener("click", () => Palpate.saveFigure(figure));
    (figure.querySelector("figcaption") || figure).append(button);
  }
};
