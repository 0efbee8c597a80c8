// Screen: the yard from above.
import { OPEN_LIFTS, ask, h, metres, figure, show, t, ageText, tell, row, table } from "./dom.js";
import { change, live, may, read, session, since_ms } from "./api.js";
import { YardCanvas } from "./canvas.js";
import { whyNot } from "./why.js";

let stage = null;
let chosen = null;
let kind = "photo";

export async function yardScreen(place) {
  const [{ bundles, revision }, { layers }, { lifts }, state] = await Promise.all([read("bundles"), read("layers"), read("lifts"), read("state")]);
  if (chosen && !bundles.some((one) => one.identity === chosen)) chosen = null;
  const known = { bundles, layers, lifts, state, revision };
  if (!stage || !place.contains(stage.root)) build(place);
  stage.known = known;
  refresh();
}

function build(place) {
  const canvas = h("canvas", { tabIndex: 0, id: "yard", role: "img", "aria-describedby": "yard-keys" });
  const side = h("div", { className: "panel side", id: "side", tabIndex: 0, role: "region", "aria-label": t("bundle") });
  const view = new YardCanvas(canvas, (identity) => { chosen = identity; refresh(); });
  const button = (id, word, act, props = {}) => h("button", { id, onclick: act, ...props }, word);
  const tools = h("div", { className: "tools" });
  stage = { canvas, side, view, tools, root: h("div", { className: "yard" },
    h("div", { className: "panel stage" }, tools, h("div", { className: "canvas" }, canvas), legend()), side) };
  stage.buttons = () => [
    button("as-photo", t("photo"), () => { kind = "photo"; refresh(); }, { "aria-pressed": String(kind === "photo") }),
    button("as-height", t("height"), () => { kind = "height"; refresh(); }, { "aria-pressed": String(kind === "height") }),
    button("closer", "+", () => view.zoom(1.25), { "aria-label": t("zoom.in") }),
    button("farther", "−", () => view.zoom(0.8), { "aria-label": t("zoom.out") }),
    button("whole", t("zoom.fit"), () => view.fit()), button("print", t("print"), () => window.print()),
    h("span", { className: "quiet small", id: "yard-keys" }, t("yard.keys")),
  ];
  window.barsightYard = view;
  show(place, stage.root);
}

const legend = () => h("div", { className: "legend" }, [["offer", "legend.offer"], ["taken", "legend.claimed"], ["veto", "legend.veto"],
  ["doubt", "legend.doubt"], ["blank", "legend.blank"]].map(([name, word]) => h("span", {}, h("i", { className: `swatch ${name}` }), t(word))),
  live.crane && h("span", {}, h("i", { className: "swatch crane" }), t("legend.crane")), h("span", {}, t("legend.age")));

function refresh() {
  const { known, view } = stage;
  view.crane = live.crane?.place ?? null;
  view.show({ ...known, clock_ns: clockNow(known.state), kind }, chosen);
  stage.canvas.setAttribute("aria-label", view.label());
  show(stage.tools, stage.buttons());
  show(stage.side, sideOf(known));
}

// The crane moved: only the drawing changes.
export function showCrane() {
  if (!stage) return;
  stage.view.crane = live.crane?.place ?? null;
  stage.view.draw();
}

// The yard's clock goes on between two documents.
export const clockNow = (state) => state.clock_ns + since_ms(state.read) * 1e6;

function sideOf(known) {
  const { bundles, lifts, state } = known;
  if (!state.survey) return [h("h1", {}, t("yard.empty")), h("p", {}, t("yard.empty.help"))];
  const bundle = bundles.find((one) => one.identity === chosen);
  if (bundle) return bundlePanel(bundle, known);
  const open = lifts.filter((lift) => OPEN_LIFTS.includes(lift.state)).sort((a, b) => a.rank - b.rank);
  const vetoes = state.map_vetoes.map((veto) => h("div", { className: "why" }, h("strong", {}, t(`veto.${veto.code}`)), h("div", { className: "reason" }, `${veto.code}: ${veto.reason}`)));
  return [
    h("h1", {}, t("lifts.open")), vetoes,
    open.length ? table([t("rank"), t("bundle"), t("state")], open.map((lift) => row([
      h("td", {}, String(lift.rank)),
      h("td", {}, h("button", { id: `pick-${lift.id}`, onclick: () => { chosen = lift.bundles[0]; stage.view.chosen = chosen; stage.view.look(chosen); refresh(); } }, lift.bundles.join(", "))),
      h("td", {}, t(`lift.${lift.state}`)),
    ])), t("lifts.open")) : h("p", {}, t("lifts.none")),
    h("h2", {}, t("yard.bundles", bundles.length)), h("p", { className: "quiet small" }, t("yard.choose")),
  ];
}

function bundlePanel(bundle, { lifts, state }) {
  const lift = bundle.lift && lifts.find((one) => one.id === bundle.lift.id);
  return [
    h("h1", {}, `${bundle.identity}${bundle.stock_name ? ` · ${bundle.stock_name}` : ""}`),
    lift && liftPanel(lift, clockNow(state)), figures(bundle, clockNow(state)),
    !bundle.lift && [h("h2", {}, t("why.not")), whyNot(bundle, state.map_vetoes)],
    h("p", {}, h("a", { href: `#bundle/${bundle.identity}`, id: "to-bundle" }, t("bundle.more"))),
  ];
}

export function figures(bundle, clock_ns) {
  const s = bundle.sigma;
  const pairs = [
    [t("place"), `X ${bundle.axis_centre_m[0].toFixed(3)}  Y ${bundle.axis_centre_m[1].toFixed(3)} m`],
    [t("sigma.place"), `${figure(s.lateral_m, null, 1000, "mm")} / ${figure(s.along_m, null, 1000, "mm")}`],
    [t("top"), figure(bundle.top_z_m * 1, s.top_z_m, 1000, "mm")],
    [t("yaw"), figure(bundle.yaw_deg, s.yaw_deg, 1, "°", 2)],
    [t("length"), bundle.ends_open.some(Boolean) ? t("length.open", metres(bundle.length_m)) : figure(bundle.length_m, s.length_m, 1, "m", 2)],
    [t("width"), figure(bundle.width_m, s.width_m, 1000, "mm")],
    [t("bar.diameter"), figure(bundle.bar_diameter_m, s.bar_diameter_m, 1000, "mm")],
    [t("bars"), bundle.bars ?? t("unknown")],
    [t("mass"), figure(bundle.mass_kg, s.mass_kg, 1, "kg")],
    [t("seen"), ageText(clock_ns - bundle.seen_ns)], [t("map"), bundle.map_id],
  ];
  return h("dl", {}, pairs.map(([name, value]) => [h("dt", {}, name), h("dd", {}, String(value))]));
}

const at = (place) => `X ${place.x_m.toFixed(2)}  Y ${place.y_m.toFixed(2)}  Z ${place.z_m === null ? "–" : place.z_m.toFixed(2)} m · ${place.yaw_deg.toFixed(1)}°`;
// What the crane's own display must say there, where that differs: the magnet hangs off its readings, or the load off the magnet's middle.
const readings = (word, place, crane) => crane && at(crane) !== at(place) && [t(word), at(crane)];

// clock_ns: the yard's.
export function liftPanel(lift, clock_ns) {
  const pull = lift.pull_low_n === null ? t("unknown") : `${(lift.pull_low_n / 1000).toFixed(0)} / ${(lift.pull_needed_n / 1000).toFixed(0)} kN`;
  const to = lift.set_down;
  return [
    h("ol", { className: "steps" }, ["offered", "claimed", "executing", "executed", "verified"].map((state) => h("li", { className: state === lift.state ? "at" : "" }, t(`lift.${state}`))),
      ["expired", "failed"].includes(lift.state) && h("li", { className: "at" }, t(`lift.${lift.state}`))),
    h("dl", {}, [
      [t("lift.target"), at(lift.target)], readings("lift.readings", lift.target, lift.crane_target),
      [t("lift.takes"), t("lift.sure", lift.count, Math.min(100 * lift.count_probability, 99.99).toFixed(2))],
      [t("mass"), figure(lift.mass_kg, lift.mass_sigma_kg, 1, "kg")], [t("lift.pull"), pull],
      [t("lift.setdown"), to ? at(to) : "–"], to && readings("lift.setdown.readings", to, lift.crane_set_down), lift.state !== "executing" && lift.valid_until_ns !== null && [t("lift.until"), ageText(lift.valid_until_ns - clock_ns)], [t("map"), lift.map_id],
    ].filter(Boolean).map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)])),
    liftButtons(lift),
  ];
}

const LATE_NS = 3600e9; // so long a lift that was made after its confirmation ended can be told here

// clock_ns: the yard's, for lifts that have ended.
export function liftButtons(lift, clock_ns = Infinity) {
  const act = (path, body, word) => change("POST", `/api/lifts/${lift.id}/${path}`, body).then(() => tell(t(word)), (error) => tell(error.message));
  const which = `${lift.bundles.join(", ")} · ${t("map")} ${lift.map_id}`;
  const late = lift.state === "expired" && h("p", {}, t("lift.late.text"));
  const ended = async (state, title) => {
    const given = await ask(t(title), [h("p", {}, which), late], [["note", t("reason")]], t("accept"), lift);
    if (given) act("end", { state, note: given.note }, `told.${state}`);
  };
  const taken = async () => {
    if (!late || await ask(t("lift.taken"), [h("p", {}, which), late], [], t("accept"), lift)) act("taken", {}, "told.taken");
  };
  const confirm = async () => {
    const fields = session.name === "local" ? [["name", t("your.name")]] : [];
    const text = [h("p", {}, t("lift.confirm.text", lift.rank, lift.bundles.join(", "))), h("dl", {}, h("dt", {}, t("map")), h("dd", {}, lift.map_id), h("dt", {}, t("calibration")), h("dd", {}, lift.calibration_id),
      h("dt", {}, t("role")), h("dd", {}, `${session.name} · ${t(`role.${session.role}`)}`))];
    const given = await ask(t("lift.confirm"), text, fields, t("lift.confirm"), lift);
    if (given) act("confirm", { map_id: lift.map_id, name: given.name || "" }, "told.confirmed");
  };
  const button = (id, word, onclick, className, right) => h("button", { id: `${id}-${lift.id}`, onclick, className, disabled: !may(right) }, t(word));
  const ends = [button("taken", "lift.taken", taken, "main", "execute"),
    button("failed", "lift.report.failed", () => ended("failed", "lift.report.failed"), "", "execute")];
  const isLate = lift.steps.some((step) => step.state === "claimed") && clock_ns - lift.steps[lift.steps.length - 1].at_ns < LATE_NS;
  const buttons = {
    expired: () => (isLate ? ends : []),
    offered: () => [button("confirm", "lift.confirm", confirm, "main", "operate"), button("decline", "lift.decline", () => ended("expired", "lift.decline"), "", "operate")],
    executing: () => ends,
    claimed: () => [...ends, button("back", "lift.back", () => ended("expired", "lift.back"), "", "operate")],
  }[lift.state];
  return buttons ? h("div", { className: "buttons" }, buttons()) : null;
}
