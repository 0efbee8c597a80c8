// Screen: a survey's surface in 3D with bundles and offered lifts, drawn by WebGL.
import { h, pixelRatio, pointOf, show, t, timeText, tell } from "./dom.js";
import { read } from "./api.js";

const FIELD = (50 * Math.PI) / 180;
const LINES = { free: [57, 211, 83], covered: [242, 177, 52], axes: [255, 255, 255], poles: [255, 47, 179] };
const COLOURS = ["height", "sigma", "views", "source"];
const POINTS = `#version 300 es
uniform mat4 view; uniform float size; in vec3 place; in vec3 colour; out vec3 shade;
void main() { gl_Position = view * vec4(place, 1.0); gl_PointSize = clamp(size / gl_Position.w, 1.5, 64.0); shade = colour; }`;
const PAINT = `#version 300 es
precision mediump float; in vec3 shade; out vec4 colour; void main() { colour = vec4(shade, 1.0); }`;

let stage = null;
let chosen = { map: null, by: "height" };

export async function modelScreen(place) {
  const { surveys } = await read("surveys");
  if (!surveys.length) return show(place, h("section", {}, h("h1", {}, t("model")), h("p", {}, t("yard.empty"))));
  if (!surveys.some((one) => one.map_id === chosen.map)) chosen.map = surveys[0].map_id;
  if (!stage || !place.contains(stage.root)) build(place);
  if (!stage.model) return;
  show(stage.tools, tools(surveys));
  await refresh();
}

function build(place) {
  const canvas = h("canvas", { tabIndex: 0, id: "model", role: "img", "aria-describedby": "model-keys" });
  const [bar, legend] = [h("div", { className: "tools" }), h("div", { className: "legend", id: "model-told" })];
  stage = { canvas, legend, tools: bar, shown: null, root: h("div", { className: "yard whole" }, h("div", { className: "panel stage" }, bar, h("div", { className: "canvas" }, canvas), legend)) };
  stage.model = Model.on(canvas);
  show(place, stage.model ? stage.root : h("section", {}, h("h1", {}, t("model")), h("p", {}, t("model.none"))));
  window.barsightModel = stage.model;
}

function tools(surveys) {
  const choice = (id, word, options, value, choose) => [h("label", { htmlFor: id, className: "row" }, t(word)), h("select", { id, onchange: (event) => { choose(event.target.value); refresh(); } },
    options.map(([each, text]) => h("option", { value: each, selected: each === value }, text)))];
  const { model } = stage;
  const button = (id, word, act, label) => h("button", { id, onclick: act, "aria-label": label ?? null }, word);
  return [h("h1", {}, t("model")), choice("model-survey", "model.survey", surveys.map((one) => [one.map_id, `${timeText(one.captured_to_ns)} · ${one.map_id}`]), chosen.map, (map) => { chosen.map = map; }),
    choice("model-by", "model.by", COLOURS.map((each) => [each, t(`model.${each}`)]), chosen.by, (by) => { chosen.by = by; }),
    button("model-closer", "+", () => model.zoom(0.8), t("zoom.in")), button("model-farther", "−", () => model.zoom(1.25), t("zoom.out")), button("model-whole", t("zoom.fit"), () => model.fit()),
    h("span", { className: "quiet small", id: "model-keys" }, t("model.keys"))];
}

async function refresh() {
  const wanted = `${chosen.map}/${chosen.by}`;
  if (stage.shown !== wanted) {
    const answer = await fetch(`/api/surveys/${chosen.map}/model?by=${chosen.by}`);
    if (!answer.ok) return tell((await answer.json().catch(() => ({}))).problem || answer.statusText);
    const packed = unpack(await answer.arrayBuffer());
    if (wanted !== `${chosen.map}/${chosen.by}`) return;
    stage.model.show(packed, !stage.shown?.startsWith(chosen.map));
    stage.shown = wanted;
  }
  const { head } = stage.model.packed;
  const swatch = (rgb) => { const one = h("i", { className: "swatch" }); one.style.background = `rgb(${rgb})`; return one; };
  const ramp = h("i", { className: "swatch ramp" });
  ramp.style.background = `linear-gradient(90deg, ${head.ramp.map((rgb) => `rgb(${rgb})`)})`;
  show(stage.legend, h("span", {}, ramp, t("model.points", head.points.toLocaleString("en"), head.total.toLocaleString("en"), head.caption)),
    head.lines.map(([name]) => h("span", {}, swatch(LINES[name]), t(`model.${name}`))));
  stage.canvas.setAttribute("aria-label", t("model.canvas", head.points));
}

// Length of the head, head, places, ends of lines, colours.
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const count = head.lines.reduce((sum, [, segments]) => sum + segments, 0);
  const places = new Float32Array(buffer, 4 + length, 3 * head.points);
  const ends = new Float32Array(buffer, 4 + length + places.byteLength, 6 * count);
  const colours = new Uint8Array(buffer, 4 + length + places.byteLength + ends.byteLength, 3 * head.points);
  return { head, places, ends, colours };
}

// A camera that looks at a middle from a distance, turned about Z by `turn` and raised by `rise`.
class Model {
  static on(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    return gl && new Model(canvas, gl);
  }

  constructor(canvas, gl) {
    Object.assign(this, { canvas, gl, packed: null, looks: null, frames: 0 });
    this.program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, POINTS], [gl.FRAGMENT_SHADER, PAINT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
    }
    gl.bindAttribLocation(this.program, 0, "place");
    gl.bindAttribLocation(this.program, 1, "colour");
    gl.linkProgram(this.program);
    gl.enable(gl.DEPTH_TEST);
    this.buffers = [0, 1, 2].map(() => gl.createBuffer());
    new ResizeObserver(() => this.draw()).observe(canvas);
    this.listen();
  }

  show(packed, isOther) {
    const { gl } = this;
    this.packed = packed;
    [packed.places, packed.colours, packed.ends].forEach((data, k) => { gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[k]); gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW); });
    if (isOther || !this.looks) this.fit();
    this.draw();
  }

  fit() {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    const { places } = this.packed;
    for (let k = 0; k < places.length; k += 1) { const a = k % 3; low[a] = Math.min(low[a], places[k]); high[a] = Math.max(high[a], places[k]); }
    const reach = Math.max(Math.hypot(...high.map((value, a) => value - low[a])), 1);
    this.reach = reach;
    this.spacing = Math.min(0.1, Math.max(0.004, Math.sqrt(((high[0] - low[0]) * (high[1] - low[1])) / Math.max(places.length / 3, 1))));
    this.looks = { middle: low.map((value, a) => (value + high[a]) / 2), turn: -Math.PI / 2 - 0.16, rise: 0.68, distance: 0.8 * reach };
    this.draw();
  }

  axes() {
    const { turn, rise } = this.looks;
    const back = [Math.cos(turn) * Math.cos(rise), Math.sin(turn) * Math.cos(rise), Math.sin(rise)];
    const right = [-Math.sin(turn), Math.cos(turn), 0];
    const up = [-Math.cos(turn) * Math.sin(rise), -Math.sin(turn) * Math.sin(rise), Math.cos(rise)];
    return { right, up, back };
  }

  matrix() {
    const { middle, distance } = this.looks;
    const { right, up, back } = this.axes();
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const [near, far] = [Math.max(0.05, distance - this.reach), distance + 2 * this.reach];
    const g = 1 / Math.tan(FIELD / 2);
    const x = (g * this.canvas.height) / this.canvas.width;
    const [a, b] = [(far + near) / (near - far), (2 * far * near) / (near - far)];
    const moved = [-dot(right, middle), -dot(up, middle), -dot(back, middle) - distance];
    const columns = [0, 1, 2].map((k) => [x * right[k], g * up[k], a * back[k], -back[k]]);
    return new Float32Array([...columns.flat(), x * moved[0], g * moved[1], a * moved[2] + b, -moved[2]]);
  }

  draw() {
    if (this.waiting || !this.packed) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.paint(); this.frames += 1; });
  }

  paint() {
    const { gl, canvas, program } = this;
    const ratio = pixelRatio(canvas);
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.776, 0.784, 0.792, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(program);
    gl.uniformMatrix4fv(gl.getUniformLocation(program, "view"), false, this.matrix());
    gl.uniform1f(gl.getUniformLocation(program, "size"), (1.7 * this.spacing * height) / (2 * Math.tan(FIELD / 2)));
    gl.enableVertexAttribArray(0);
    gl.enableVertexAttribArray(1);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[0]);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[1]);
    gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 0, 0);
    gl.drawArrays(gl.POINTS, 0, this.packed.head.points);
    gl.disableVertexAttribArray(1);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[2]);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    let first = 0;
    for (const [name, segments] of this.packed.head.lines) {
      gl.vertexAttrib3f(1, ...LINES[name].map((value) => value / 255));
      gl.drawArrays(gl.LINES, first, 2 * segments);
      first += 2 * segments;
    }
  }

  turn(dx, dy) {
    this.looks.turn -= dx / 180;
    this.looks.rise = Math.min(1.55, Math.max(-0.1, this.looks.rise + dy / 180));
    this.draw();
  }

  move(dx, dy) {
    const metres = (2 * this.looks.distance * Math.tan(FIELD / 2)) / Math.max(this.canvas.clientHeight, 1);
    const { right, up } = this.axes();
    this.looks.middle = this.looks.middle.map((value, a) => value - metres * (dx * right[a] - dy * up[a]));
    this.draw();
  }

  zoom(factor) {
    this.looks.distance = Math.min(5 * this.reach, Math.max(0.5, this.looks.distance * factor));
    this.draw();
  }

  listen() {
    const { canvas } = this;
    let from = null;
    canvas.addEventListener("pointerdown", (e) => { from = pointOf(e); canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointermove", (e) => {
      if (!from || !this.looks) return;
      const to = pointOf(e);
      (e.shiftKey || e.buttons === 2 ? this.move : this.turn).call(this, to[0] - from[0], to[1] - from[1]);
      from = to;
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { from = null; });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); if (this.looks) this.zoom(Math.exp(e.deltaY / 600)); }, { passive: false });
    canvas.addEventListener("keydown", (e) => this.key(e));
  }

  key(e) {
    if (!this.looks) return;
    const ways = { ArrowLeft: [-30, 0], ArrowRight: [30, 0], ArrowUp: [0, -30], ArrowDown: [0, 30] };
    if (ways[e.key]) (e.shiftKey ? this.move : this.turn).call(this, ...ways[e.key]);
    else if (e.key === "+" || e.key === "=") this.zoom(0.8);
    else if (e.key === "-") this.zoom(1.25);
    else if (e.key === "0") this.fit();
    else return;
    e.preventDefault();
  }
}
