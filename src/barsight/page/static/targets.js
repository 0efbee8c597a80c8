// Screen: surveyed targets picked on a survey's photo, saved as the list that `barsight calibrate yard` takes.
import { ask, h, pixelRatio, pointOf, row, show, t, table, tell, timeText } from "./dom.js";
import { change, get, may, read } from "./api.js";
import { YardCanvas } from "./canvas.js";

const LOUPE = 1500; // pixels a metre
const MAX_PIXELS = 4e6; // of a picture that the server paints cell by cell
const COLUMNS = "name,yard_x,yard_y,yard_z,sigma_m,check,width_m\n";
const PICKED = "#b30059";
const NUDGES = { ArrowLeft: [-0.001, 0], ArrowRight: [0.001, 0], ArrowUp: [0, 0.001], ArrowDown: [0, -0.001] };

let stage = null;
let map = null;
let work = null; // list, sigma and picks: kept in the browser, by map
let told = null; // what the server says of them
let chosen = null;
let queue = Promise.resolve();

export async function targetScreen(place) {
  if (!may("administer")) return show(place, h("section", {}, h("h1", {}, t("targets")), h("p", {}, t("targets.not"))));
  const { surveys } = await read("surveys");
  if (!surveys.length) return show(place, h("section", {}, h("h1", {}, t("targets")), h("p", {}, t("yard.empty"))));
  const isNew = !stage || !place.contains(stage.root);
  if (isNew) build(place);
  show(stage.tools, tools(surveys));
  if (isNew || !surveys.some((one) => one.map_id === map)) await open(surveys.some((one) => one.map_id === map) ? map : surveys[0].map_id);
}

function build(place) {
  const canvas = h("canvas", { tabIndex: 0, id: "photo", role: "img", "aria-describedby": "photo-keys" });
  const loupe = h("canvas", { id: "loupe", role: "img", "aria-label": t("targets.loupe") });
  const view = new PhotoCanvas(canvas, loupe, (...place) => inTurn(() => pick(...place)), (step) => inTurn(() => nudge(step)));
  const bar = h("div", { className: "tools" });
  const side = h("div", { className: "panel side", id: "targets", tabIndex: 0, role: "region", "aria-label": t("targets") });
  stage = { canvas, loupe, view, side, tools: bar, root: h("div", { className: "yard" }, h("div", { className: "panel stage" }, bar, h("div", { className: "canvas" }, canvas)), side) };
  window.barsightTargets = view;
  show(place, stage.root);
}

function tools(surveys) {
  const { view } = stage;
  const button = (id, word, act, label) => h("button", { id, onclick: act, "aria-label": label ?? null }, word);
  return [h("label", { htmlFor: "target-survey", className: "row" }, t("model.survey")),
    h("select", { id: "target-survey", onchange: (event) => open(event.target.value) }, surveys.map((one) => h("option", { value: one.map_id, selected: one.map_id === map }, `${timeText(one.captured_to_ns)} · ${one.map_id}`))),
    button("photo-closer", "+", () => view.zoom(1.5), t("zoom.in")), button("photo-farther", "−", () => view.zoom(1 / 1.5), t("zoom.out")), button("photo-whole", t("zoom.fit"), () => view.fit()),
    h("span", { className: "quiet small", id: "photo-keys" }, t("targets.keys"))];
}

const key = () => `barsight.targets.${map}`;

async function open(wanted) {
  map = wanted;
  [work, told, chosen, stage.grid] = [null, null, null, null];
  try {
    const grid = await get(`/api/surveys/${map}/targets`);
    if (map !== wanted) return;
    stage.grid = grid;
    stage.view.open(grid);
    const kept = JSON.parse(localStorage.getItem(key()) || "null");
    if (kept) await submit(kept).catch((error) => tell(error.message));
  } catch (error) {
    return show(stage.side, h("h1", {}, t("targets")), h("p", { role: "alert", className: "long" }, error.message));
  }
  refresh();
}

// Have the server place all picks; what it refuses changes nothing.
async function submit(changed) {
  const asked = map;
  const answer = await change("POST", `/api/surveys/${asked}/targets`, changed);
  if (asked !== map) return;
  [work, told] = [changed, answer];
  localStorage.setItem(key(), JSON.stringify(work));
  const picked = told.targets.map((one) => one.name);
  const free = told.names.filter((one) => !picked.includes(one.name));
  const last = changed.picks[changed.picks.length - 1];
  if (!chosen || (picked.includes(chosen) && !last?.is_exact)) chosen = free.length ? free[0].name : chosen;
}

// One after the other: a click waits for the one before, whose target it would take otherwise.
function inTurn(act) {
  queue = queue.then(act).catch((error) => tell(error.message));
}

async function putPicks(picks, name) {
  await submit({ ...work, picks });
  refresh(name);
}

const others = (name) => work.picks.filter((one) => one.name !== name);

// is_exact: that very place, not the middle of the disc beside it.
async function pick(x_m, y_m, is_exact) {
  if (!told || !chosen) return tell(t("targets.choose"));
  await putPicks([...others(chosen), { name: chosen, x_m, y_m, is_exact }], chosen);
}

async function nudge([dx, dy]) {
  const target = told?.targets.find((one) => one.name === chosen);
  if (!target) return tell(t("targets.choose"));
  await pick(target.place_m[0] + dx, target.place_m[1] + dy, true);
}

// looked: name of the target that the loupe shows.
function refresh(looked) {
  const { view, side, canvas, loupe } = stage;
  canvas.setAttribute("aria-label", t("targets.canvas", told ? told.targets.length : 0));
  show(side, h("h1", {}, t("targets")), told ? [loupe, picksOf(), fitOf()] : listOf());
  view.mark(told ? told.targets : [], looked);
}

function listOf() {
  const listed = h("textarea", { id: "listed", spellcheck: false, value: COLUMNS });
  const sigma = h("input", { id: "survey-sigma", type: "number", min: "0.1", step: "0.1", value: "1.0", required: true });
  const file = h("input", { id: "listed-file", type: "file", accept: ".csv,text/csv", className: "wide", onchange: async () => { if (file.files.length) listed.value = await file.files[0].text(); } });
  const problem = h("p", { role: "alert", className: "long" });
  const take = (event) => {
    event.preventDefault();
    submit({ listed: listed.value, sigma_m: Number(sigma.value) / 1000, picks: [] }).then(() => refresh(), (error) => { problem.textContent = error.message; });
  };
  return h("form", { id: "take-list", onsubmit: take }, h("label", { htmlFor: "listed" }, t("targets.list")), listed, h("p", { className: "quiet small" }, t("targets.list.help")),
    h("label", { htmlFor: "listed-file" }, t("targets.file")), file, h("label", { htmlFor: "survey-sigma" }, t("targets.sigma")), sigma,
    h("div", { className: "buttons" }, h("button", { className: "main" }, t("targets.take"))), problem);
}

const millimetres = (value) => (1000 * value).toFixed(1);

function picksOf() {
  const rows = told.names.map(({ name, check }, k) => {
    const target = told.targets.find((one) => one.name === name);
    const [x, y, z] = target ? target.place_m.map((value) => value.toFixed(3)) : [];
    const choose = () => { chosen = name; refresh(name); };
    return row([
      h("td", {}, h("button", { id: `target-${k}`, "aria-pressed": String(chosen === name), onclick: choose }, name), check && h("span", { className: "quiet small" }, ` ${t("targets.check")}`),
        h("div", { className: "small quiet" }, target ? [h("span", { className: "at" }, t("targets.place", x, y, z)), h("br"), h("span", {}, `${t("targets.spread", millimetres(target.sigma_m[0]), millimetres(target.sigma_m[2]))}, ${t(`targets.found.${target.found}`)}`)] : t("targets.unpicked"))),
      h("td", { className: "n" }, target?.off_m ? [h("strong", {}, millimetres(Math.hypot(...target.off_m))), h("div", { className: "small quiet" }, target.off_m.map((value) => `${value < 0 ? "−" : "+"}${millimetres(Math.abs(value))}`).join(" "))] : "–"),
      h("td", {}, target && h("button", { id: `remove-${k}`, "aria-label": t("targets.remove", name), onclick: () => inTurn(() => putPicks(others(name))) }, "×")),
    ]);
  });
  return h("div", { className: "targets" }, table([t("targets.name"), `#${t("targets.off")}`, t("to.do")], rows, t("targets")));
}

function fitOf() {
  const { fit, csv } = told;
  const pairs = fit && !fit.problem ? [[t("targets.turn"), `± ${fit.turn_sigma_deg.toFixed(4)}°`], [t("targets.shift"), `± ${millimetres(fit.place_sigma_m)} mm`], [t("targets.scale"), `${fit.scale.toFixed(5)} ± ${fit.scale_sigma.toFixed(5)}`]] : [];
  const command = `barsight calibrate yard targets.csv --measured ${stage.grid.folder} -o yard.yaml`;
  return [h("h2", {}, t("targets.fit")), h("div", { id: "target-fit" }, !fit ? h("p", {}, t("targets.more")) : fit.problem ? h("p", {}, fit.problem) : h("dl", {}, pairs.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)])),
    fit?.doubts?.map((doubt) => h("p", { className: "why" }, doubt))),
    h("div", { className: "buttons" }, h("button", { id: "save-targets", className: "main", disabled: !csv, onclick: save }, t("targets.save")), h("button", { id: "other-list", onclick: forgetList }, t("targets.other"))),
    csv && [h("p", { className: "quiet small" }, t("targets.next")), h("code", { className: "long small" }, command)]];
}

function save() {
  const link = h("a", { href: URL.createObjectURL(new Blob([told.csv], { type: "text/csv" })), download: "targets.csv" });
  link.click();
  URL.revokeObjectURL(link.href);
}

async function forgetList() {
  if (!(await ask(t("targets.other"), t("targets.other.text", told.targets.length), [], t("accept")))) return;
  localStorage.removeItem(key());
  [work, told, chosen] = [null, null, null];
  refresh();
}

// The photo cell by cell: as a whole, and sharper where it is looked at closely.
class PhotoCanvas extends YardCanvas {
  constructor(canvas, loupe, onPlace, onNudge) {
    super(canvas, () => {});
    Object.assign(this, { loupe, onPlace, onNudge, targets: [], looked: null, isExact: false });
    canvas.addEventListener("pointerdown", (e) => { this.isExact = e.shiftKey; });
    canvas.addEventListener("pointermove", (e) => { if (this.view) this.look(this.at(...pointOf(e))); });
  }

  open(grid) {
    this.grid = grid;
    this.view = null;
    this.pictures.clear();
    this.whole = this.layer([0, grid.columns], [0, grid.rows]);
    this.isSharp = grid.columns * grid.rows <= MAX_PIXELS;
    this.show({ bundles: [], lifts: [], layers: [this.whole], clock_ns: 0 }, null);
  }

  layer([left, right], [low, high]) {
    const { cell_m: cell, left_m, low_m, map_id } = this.grid;
    return { seen_ns: 0, edges_m: [left_m + left * cell, low_m + low * cell, left_m + right * cell, low_m + high * cell], url: `/api/surveys/${map_id}/photo.png?left=${left}&right=${right}&low=${low}&high=${high}` };
  }

  load(layer, loaded = () => {}) {
    if (this.pictures.has(layer.url)) return;
    const picture = new Image();
    picture.onload = () => { loaded(); this.moving = null; this.draw(); this.drawLoupe(); };
    picture.src = layer.url;
    this.pictures.set(layer.url, picture);
  }

  draw() {
    super.draw();
    clearTimeout(this.timer);
    if (this.grid && !this.isSharp) this.timer = setTimeout(() => this.sharpen(), 150);
  }

  sharpen() {
    const { cell_m: cell, left_m, low_m, columns, rows } = this.grid;
    const [[x0, y0], [x1, y1]] = [this.at(0, this.height), this.at(this.width, 0)];
    const within = (value, last) => Math.min(Math.max(value, 0), last);
    const across = [within(Math.floor((x0 - left_m) / cell), columns - 1), within(Math.ceil((x1 - left_m) / cell), columns)];
    const up = [within(Math.floor((y0 - low_m) / cell), rows - 1), within(Math.ceil((y1 - low_m) / cell), rows)];
    if (across[1] <= across[0] || up[1] <= up[0]) return;
    const layer = this.layer(across, up);
    this.load(layer, () => {
      this.data.layers = [this.whole, layer];
      for (const url of [...this.pictures.keys()]) if (url !== this.whole.url && url !== layer.url) this.pictures.delete(url);
    });
  }

  mark(targets, name) {
    this.targets = targets;
    this.moving = null;
    const target = targets.find((one) => one.name === name);
    if (target) this.look(target.place_m);
    else this.drawLoupe();
    this.draw();
  }

  look(place) {
    this.looked = place;
    this.drawLoupe();
  }

  paintYard(c) {
    c.fillStyle = "#c6c8ca";
    c.fillRect(0, 0, this.width, this.height);
    this.paintLayers(c);
    this.paintGrid(c);
    this.paintTargets(c);
  }

  paintTargets(c) {
    c.font = "bold 13px sans-serif";
    c.textBaseline = "middle";
    for (const { name, place_m } of this.targets) {
      const [px, py] = this.place(...place_m);
      cross(c, px, py, 11);
      const wide = c.measureText(name).width;
      const left = px + 18 + wide > this.width ? px - 18 - wide : px + 16;
      c.textAlign = "left";
      c.fillStyle = "#dcdddfe0";
      c.fillRect(left - 3, py - 10, wide + 6, 20);
      c.fillStyle = "#16191b";
      c.fillText(name, left, py);
    }
  }

  paint() {
    super.paint();
    if (document.activeElement === this.canvas) cross(this.canvas.getContext("2d"), this.width / 2, this.height / 2, 6);
  }

  drawLoupe() {
    if (!this.looked || !this.loupe.isConnected) return;
    const { view, width, height, loupe } = this;
    const ratio = pixelRatio(loupe);
    Object.assign(loupe, { width: Math.round(loupe.clientWidth * ratio), height: Math.round(loupe.clientHeight * ratio) });
    const c = loupe.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    Object.assign(this, { view: { x: this.looked[0], y: this.looked[1], scale: LOUPE }, width: loupe.clientWidth, height: loupe.clientHeight });
    this.paintLayers(c);
    cross(c, this.width / 2, this.height / 2, 25);
    Object.assign(this, { view, width, height });
  }

  pick(px, py) { this.onPlace(...this.at(px, py), this.isExact); }

  key(e) {
    if (e.shiftKey && NUDGES[e.key]) this.onNudge(NUDGES[e.key]);
    else if (e.key === "Enter") this.onPlace(this.view.x, this.view.y, false);
    else if (!["n", "p", "Escape"].includes(e.key)) return super.key(e);
    e.preventDefault();
  }
}

// Two strokes with a free middle, readable over black and white.
function cross(c, px, py, reach) {
  for (const [style, width] of [["#f2f2f2", 4], [PICKED, 2]]) {
    c.strokeStyle = style;
    c.lineWidth = width;
    c.beginPath();
    for (const [x, y] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { c.moveTo(px + 3 * x, py + 3 * y); c.lineTo(px + reach * x, py + reach * y); }
    c.stroke();
  }
}
