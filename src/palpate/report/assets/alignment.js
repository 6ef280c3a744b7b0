"use strict";
// Both images whole, the later one over the earlier: bones must stand still while one fades into the other.
Palpate.Alignment = class extends Palpate.Planes {
  constructor(facts, number, section) {
    super(facts, facts.later[number], section, facts.references[facts.later[number].reference].whole);
    this.fade = section.querySelector(".fade");
    this.button = section.querySelector(".play");
    this.fade.addEventListener("input", () => { this.play(false); this.draw(); });
    this.button.addEventListener("click", () => this.play(!this.timer));
    this.start();
  }

  volumes() { return this.later.both; }

  play(on) { Palpate.play(this, on); }

  draw() {
    Palpate.tellFade(this);
    super.draw();
  }

  // By the role: bones are what is aligned.
  labelColours() {
    const light = { rigid: 1, estimate: 0.6, driver: 0.6, known: 0.2, void: 0 };
    return [[0, 0, 0], ...this.facts.tissues.map((t) => Palpate.rgb(t.colour).map((c) => 255 * light[t.role] * c))];
  }

  paintPlane(context, view, frame, layers) {
    const share = Number(this.fade.value) / 100, [earlier, later] = this.later.both;
    this.drawVolume(context, view, frame, earlier, layers);
    context.globalAlpha = share;
    if (share) this.drawVolume(context, view, frame, later, layers);
    context.globalAlpha = 1;
    for (const s of this.reference.surfaces) {
      if (this.facts.tissues[s.tissue].role === "rigid") this.stroke(context, view, frame, s, layers, { lineWidth: 2, dash: [0.1, 3.6], strokeStyle: "#ffd24a" });
    }
    return share <= 0.5 ? this.reference.name : this.later.name;
  }
};
