// Screen: the yard at any past time, and what changed between two.
import { h, row, show, t, table, timeText } from "./dom.js";
import { get, read } from "./api.js";
import { YardCanvas } from "./canvas.js";

let chosen = { before: null, after: null };
let stage = null;

export async function timelineScreen(place) {
  const { surveys } = await read("surveys");
  const times = surveys.map((one) => one.captured_to_ns).reverse();
  if (!times.length) return show(place, h("section", {}, h("h1", {}, t("timeline")), h("p", {}, t("yard.empty"))));
  if (!times.includes(chosen.after)) chosen = { before: times[Math.max(times.length - 2, 0)], after: times[times.length - 1] };
  if (!stage || !place.contains(stage.root)) build(place, times);
  stage.times = times;
  for (const slider of stage.sliders) slider.max = times.length - 1;
  await refresh();
}

function build(place, times) {
  const canvas = h("canvas", { tabIndex: 0, id: "past-yard", role: "img" });
  const side = h("div", { className: "panel side", tabIndex: 0, role: "region", "aria-label": t("changes") });
  const texts = { before: h("output", { id: "before-text" }), after: h("output", { id: "after-text" }) };
  const slider = (name, word) => {
    const input = h("input", { type: "range", id: name, min: 0, max: times.length - 1, step: 1, value: times.indexOf(chosen[name]), oninput: () => { chosen[name] = stage.times[Number(input.value)]; refresh(); } });
    return [input, h("div", { className: "panel" }, h("label", { htmlFor: name }, t(word), " ", texts[name]), input)];
  };
  const [[before, first], [after, second]] = [slider("before", "timeline.before"), slider("after", "timeline.after")];
  stage = { canvas, side, texts, times, sliders: [before, after], view: new YardCanvas(canvas, () => {}) };
  stage.root = h("div", { className: "yard" }, h("div", { className: "panel stage" }, h("div", { className: "times" }, first, second), h("div", { className: "canvas" }, canvas),
    h("div", { className: "legend" }, h("span", {}, h("i", { className: "swatch went" }), t("legend.went")), h("span", {}, h("i", { className: "swatch offer" }), t("legend.came")))), side);
  show(place, stage.root);
}

async function refresh() {
  const wanted = { ...chosen };
  for (const name of ["before", "after"]) {
    stage.texts[name].textContent = timeText(wanted[name]);
    stage.sliders[name === "before" ? 0 : 1].setAttribute("aria-valuetext", timeText(wanted[name]));
  }
  const [yard, { changes }] = await Promise.all([get(`/api/yard?at_ns=${exact(wanted.after)}`), get(`/api/compare?before_ns=${exact(wanted.before)}&after_ns=${exact(wanted.after)}`)]);
  if (wanted.after !== chosen.after || wanted.before !== chosen.before) return;
  stage.view.show({ ...yard, at_ns: exact(wanted.after), clock_ns: wanted.after, kind: "photo", lifts: [], revision: 0, changes }, null);
  stage.canvas.setAttribute("aria-label", stage.view.label());
  const centre = (place) => (place ? `${place[0].toFixed(2)} / ${place[1].toFixed(2)}` : "–");
  show(stage.side, h("h1", {}, t("changes")), changes.length ? table([t("bundle"), t("what"), "#X / Y m", "#X / Y m"], changes.map((one) => row([
    h("td", {}, h("a", { href: `#bundle/${one.identity}` }, one.identity)), h("td", {}, t(`change.${one.what}`)), centre(one.from_m), centre(one.to_m)])), t("changes")) : h("p", {}, t("changes.none")));
}

// Stamps in ns are longer than a number holds: a millisecond later includes the survey that is meant.
const exact = (ns) => String(BigInt(Math.ceil(ns / 1e6)) * 1000000n + 1000000n);
