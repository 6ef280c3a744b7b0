"use strict";
// Start every moving figure when it comes near the window; one that fails leaves its picture where it is.
(async () => {
  Palpate.theme();
  Palpate.copies();
  if (Palpate.saves) Palpate.saves();
  const facts = await Palpate.load();
  const soon = (section, start) => {
    const observer = new IntersectionObserver((entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      observer.disconnect();
      const live = section.querySelector(".live"), still = section.querySelector(".still");
      try {
        Palpate.replace(live, still);
        start();
        section.dataset.state = "live";
      } catch (error) {
        live.hidden = true;
        still.classList.remove("replaced");
        section.dataset.state = "still";
        console.warn("this figure stays a picture:", error);
      }
    }, { rootMargin: "300px" });
    observer.observe(section);
  };
  for (const section of document.querySelectorAll("section.slices")) {
    const number = Number(section.dataset.later);
    if (facts.references[facts.later[number].reference].slices) soon(section, () => new Palpate.Slices(facts, number, section));
  }
  for (const section of document.querySelectorAll("section.alignment")) {
    const number = Number(section.dataset.later);
    if (facts.later[number].both.length) soon(section, () => new Palpate.Alignment(facts, number, section));
  }
  for (const section of document.querySelectorAll("section.preview")) {
    soon(section, () => new Palpate.Preview(facts, Number(section.dataset.later), section));
  }
  const measured = [...document.querySelectorAll("section.points")].map((section) => [section, facts.measured[Number(section.dataset.measured)]]);
  for (const [section, state] of measured) soon(section.querySelector(".in-slices"), () => new Palpate.PointSlices(facts, state, section));
  if (!Palpate.supportsWebGL || !Palpate.supportsWebGL()) return; // a page without bodies does not bring them
  for (const [section, state] of measured) soon(section.querySelector(".in-space"), () => new Palpate.PointBodies(facts, state, section));
  for (const section of document.querySelectorAll("section.organs")) {
    const number = Number(section.dataset.later);
    if (facts.later[number].model.length) soon(section, () => new Palpate.Organs(facts, number, section));
  }
  const mesh = document.querySelector("section.mesh");
  if (mesh && facts.mesh) soon(mesh, () => new Palpate.Mesh(facts, mesh));
})().catch((error) => console.warn("the figures stay pictures:", error));
