// The yard from above on a canvas: surveys' pictures faded by age, bundles, lifts, vetoes; pan, zoom, pick.
import { shortWhy, isForbidden } from "./why.js";
import { OPEN_LIFTS, pixelRatio, pointOf, t } from "./dom.js";

const SELECT = "#1d4f91";
const INK = "#26292b";
const CLAIMED = "#1d4f91a0";
const OFFERED = "#f2f2f2a0";
const NARROW_PX = 12; // an outline alone looks as a filled one
const RANK_PX = 13;
const PATH_ITEMS = 20;
const AROUND = 0.25; // share of the view that is drawn beyond each of its edges while it is moved
const WORDS_PX = 40; // room below the yard for the words of its lowest bundles

export class YardCanvas {
  // onPick: is given an identity or null.
  constructor(canvas, onPick) {
    this.canvas = canvas;
    this.onPick = onPick;
    this.view = null; // centre x, y (m), pixels a metre
    this.data = { bundles: [], layers: [], clock_ns: 0, kind: "photo", lifts: [] };
    this.pictures = new Map();
    this.frames = [];
    this.chosen = null;
    this.moving = null; // the drawing and more around it, while the view is moved
    this.crane = null; // place of the camera body and the magnet of a live run, m
    this.listen();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.media = matchMedia("print");
    this.media.addEventListener("change", () => this.resize());
  }

  show(data, chosen) {
    this.data = data;
    this.chosen = chosen;
    this.moving = null;
    this.items = data.bundles.map((bundle) => this.item(bundle)).sort((a, b) => a.top - b.top);
    for (const layer of data.layers) this.load(layer);
    if (!this.view) this.fit();
    this.draw();
  }

  item(bundle) {
    const [[ax, ay], [bx, by]] = bundle.ends_m;
    const length = Math.hypot(bx - ax, by - ay) || 1;
    return {
      bundle, ...outline(bundle.ends_m, bundle.width_m),
      x: (ax + bx) / 2, y: (ay + by) / 2, reach: length / 2 + bundle.width_m, low: Math.min(ay, by), top: bundle.top_z_m,
      forbidden: isForbidden(bundle), words: shortWhy(bundle),
    };
  }

  load(layer) {
    const url = `/api/layers/${layer.map_id}.png?kind=${this.data.kind}&of=${this.data.revision}${this.data.at_ns ? `&at_ns=${this.data.at_ns}` : ""}`;
    layer.url = url;
    if (this.pictures.has(url)) return;
    const picture = new Image();
    picture.onload = () => { this.moving = null; this.draw(); };
    picture.src = url;
    this.pictures.set(url, picture);
    if (this.pictures.size > 24) this.pictures.delete(this.pictures.keys().next().value);
  }

  edges() {
    const x = [];
    const y = [];
    for (const { edges_m: e } of this.data.layers) { x.push(e[0], e[2]); y.push(e[1], e[3]); }
    for (const { ends_m: e } of this.data.bundles) { x.push(e[0][0], e[1][0]); y.push(e[0][1], e[1][1]); }
    return x.length ? [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)] : [-5, -5, 5, 5];
  }

  fit() {
    const [x0, y0, x1, y1] = this.edges();
    const width = this.canvas.clientWidth || 800;
    const height = this.canvas.clientHeight || 500;
    const scale = Math.min(width / (x1 - x0 + 1), Math.max(height - 2 * WORDS_PX, 100) / (y1 - y0 + 1));
    this.moving = null;
    this.view = { x: (x0 + x1) / 2, y: (y0 + y1) / 2 - WORDS_PX / 2 / scale, scale };
    this.draw();
  }

  resize() {
    this.moving = null;
    if (this.view) this.fit();
  }

  place(x, y) {
    return [(x - this.view.x) * this.view.scale + this.width / 2, (this.view.y - y) * this.view.scale + this.height / 2];
  }

  at(px, py) {
    return [(px - this.width / 2) / this.view.scale + this.view.x, this.view.y - (py - this.height / 2) / this.view.scale];
  }

  draw() {
    if (this.waiting || !this.view) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const began = performance.now();
      this.paint();
      this.frames.push(performance.now() - began);
      if (this.frames.length > 240) this.frames.shift();
    });
  }

  paint() {
    const ratio = pixelRatio(this.canvas);
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    if (this.canvas.width !== Math.round(this.width * ratio)) this.canvas.width = Math.round(this.width * ratio);
    if (this.canvas.height !== Math.round(this.height * ratio)) this.canvas.height = Math.round(this.height * ratio);
    const c = this.canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (this.moving) this.paintMoved(c, ratio);
    else this.paintYard(c);
    this.paintScale(c);
    this.paintCrane(c);
  }

  paintYard(c) {
    c.fillStyle = "#c6c8ca";
    c.fillRect(0, 0, this.width, this.height);
    this.paintLayers(c);
    this.paintGrid(c);
    const seen = this.visible();
    this.paintBundles(c, seen);
    this.paintLifts(c);
    this.paintChanges(c);
    this.paintWords(c, seen);
  }

  // While the view is moved its drawing is moved, which was made once with more around it.
  paintMoved(c, ratio) {
    if (!this.moving.drawing || !this.covers()) this.drawAround(ratio);
    const { drawing, wide, high } = this.moving;
    const [left, top] = this.offset().map((px) => Math.round(px * ratio) / ratio);
    c.drawImage(drawing, left, top, wide, high);
  }

  offset() {
    const { view, wide, high } = this.moving;
    return [(this.width - wide) / 2 + (view.x - this.view.x) * view.scale, (this.height - high) / 2 + (this.view.y - view.y) * view.scale];
  }

  covers() {
    const { view, wide, high } = this.moving;
    const [left, top] = this.offset();
    return view.scale === this.view.scale && left <= 0 && top <= 0 && left + wide >= this.width && top + high >= this.height;
  }

  drawAround(ratio) {
    const [width, height] = [this.width, this.height];
    const drawing = this.moving.drawing || document.createElement("canvas");
    this.width = Math.round(width * (1 + 2 * AROUND));
    this.height = Math.round(height * (1 + 2 * AROUND));
    drawing.width = Math.round(this.width * ratio);
    drawing.height = Math.round(this.height * ratio);
    const c = drawing.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.paintYard(c);
    this.moving = { drawing, view: { ...this.view }, wide: this.width, high: this.height };
    Object.assign(this, { width, height });
  }

  // The bridge as two lines across the yard, the camera as a box on them, the magnet as a ring: none to scale.
  paintCrane(c) {
    if (!this.crane) return;
    const [px, py] = this.place(...this.crane.body_m);
    c.lineWidth = 1.5;
    c.strokeStyle = INK;
    c.beginPath();
    for (const side of [-5, 5]) { c.moveTo(px + side, 0); c.lineTo(px + side, this.height); }
    c.stroke();
    c.fillStyle = INK;
    c.fillRect(px - 10, py - 7, 20, 14);
    if (!this.crane.magnet_m) return;
    const [mx, my] = this.place(...this.crane.magnet_m);
    c.lineWidth = 4;
    c.strokeStyle = "#f2f2f2";
    c.beginPath(); c.arc(mx, my, 11, 0, 7); c.stroke();
    c.lineWidth = 2;
    c.strokeStyle = INK;
    c.beginPath(); c.arc(mx, my, 11, 0, 7); c.moveTo(mx - 17, my); c.lineTo(mx + 17, my); c.moveTo(mx, my - 17); c.lineTo(mx, my + 17); c.stroke();
  }

  paintLayers(c) {
    const alone = this.view.scale < 160;
    c.imageSmoothingEnabled = alone;
    for (const layer of this.data.layers) {
      const picture = this.pictures.get(layer.url);
      if (!picture || !picture.complete || !picture.naturalWidth) continue;
      const [x0, y0, x1, y1] = layer.edges_m;
      const [left, top] = this.place(x0, y1);
      c.globalAlpha = fade(this.data.clock_ns - layer.seen_ns);
      c.drawImage(picture, left, top, (x1 - x0) * this.view.scale, (y1 - y0) * this.view.scale);
    }
    c.globalAlpha = 1;
  }

  // Round metres in view, along X and along Y.
  marks() {
    const step = [1, 2, 5, 10, 20, 50].find((each) => each * this.view.scale > 70) || 100;
    const [x0, y0] = this.at(0, this.height);
    const [x1, y1] = this.at(this.width, 0);
    const between = (low, high) => Array.from({ length: Math.max(0, Math.ceil(high / step) - Math.ceil(low / step)) }, (_, k) => (Math.ceil(low / step) + k) * step);
    return [between(x0, x1), between(y0, y1)];
  }

  paintGrid(c) {
    const [xs, ys] = this.marks();
    c.strokeStyle = "#00000022";
    c.lineWidth = 1;
    c.beginPath();
    for (const x of xs) { const [px] = this.place(x, 0); c.moveTo(px, 0); c.lineTo(px, this.height); }
    for (const y of ys) { const [, py] = this.place(0, y); c.moveTo(0, py); c.lineTo(this.width, py); }
    c.stroke();
  }

  // Along the edges, over everything: how many metres.
  paintScale(c) {
    const [xs, ys] = this.marks();
    c.font = "12px sans-serif";
    c.fillStyle = "#3c4043";
    c.textAlign = "center";
    c.textBaseline = "bottom";
    c.strokeStyle = "#dcdddfd8";
    c.lineWidth = 4;
    const write = (text, px, py) => { c.strokeText(text, px, py); c.fillText(text, px, py); };
    for (const x of xs) write(`X ${x}`, this.place(x, 0)[0], this.height - 3);
    c.textAlign = "left";
    c.textBaseline = "middle";
    for (const y of ys) {
      const [, py] = this.place(0, y);
      if (py < this.height - 24) write(`Y ${y}`, 4, py);
    }
  }

  visible() {
    const [x0, y0] = this.at(0, this.height);
    const [x1, y1] = this.at(this.width, 0);
    return this.items.filter((i) => i.x + i.reach > x0 && i.x - i.reach < x1 && i.y + i.reach > y0 && i.y - i.reach < y1);
  }

  path(c, item) {
    item.corners.forEach(([x, y], k) => (k ? c.lineTo(...this.place(x, y)) : c.moveTo(...this.place(x, y))));
    c.closePath();
  }

  paintBundles(c, seen) {
    const groups = { plain: [], doubt: [] };
    for (const item of seen) groups[item.bundle.doubt ? "doubt" : "plain"].push(item);
    c.lineWidth = 1.5;
    c.strokeStyle = INK;
    for (const [name, items] of Object.entries(groups)) {
      c.setLineDash(name === "doubt" ? [6, 4] : []);
      this.each(c, items, () => c.stroke());
    }
    c.setLineDash([]);
    c.fillStyle = this.hatch(c);
    this.each(c, seen.filter((item) => item.forbidden), () => c.fill());
    const chosen = seen.find((item) => item.bundle.identity === this.chosen);
    if (chosen) {
      c.lineWidth = 2;
      c.strokeStyle = "#fff";
      c.beginPath(); this.path(c, chosen); c.stroke();
      c.lineWidth = 6; c.strokeStyle = "#16191b";
      c.beginPath(); this.path(c, chosen); c.stroke();
      c.lineWidth = 2; c.strokeStyle = "#fff";
      c.beginPath(); this.path(c, chosen); c.stroke();
    }
  }

  // Between two times: where a bundle lay that went or moved is dashed, one that came or moved has a wide line.
  paintChanges(c) {
    for (const change of this.data.changes || []) {
      for (const [ends_m, dash, width] of [[change.from_ends_m, [9, 6], 2.5], [change.to_ends_m, [], 4]]) {
        if (!ends_m) continue;
        c.beginPath(); this.path(c, outline(ends_m, change.width_m));
        for (const [style, wide, line] of [["#f2f2f2", width + 3, []], [SELECT, width, dash]]) {
          c.setLineDash(line);
          c.lineWidth = wide;
          c.strokeStyle = style;
          c.stroke();
        }
      }
    }
    c.setLineDash([]);
  }

  // Paths of few outlines: a path of thousands takes seconds.
  each(c, items, act) {
    for (let first = 0; first < items.length; first += PATH_ITEMS) {
      c.beginPath();
      for (const item of items.slice(first, first + PATH_ITEMS)) this.path(c, item);
      act();
    }
  }

  hatch(c) {
    if (this.pattern) return this.pattern;
    const tile = document.createElement("canvas");
    tile.width = tile.height = 10;
    const pen = tile.getContext("2d");
    pen.strokeStyle = "#16191bb0";
    pen.beginPath();
    for (const k of [-10, 0, 10]) { pen.moveTo(k, 10); pen.lineTo(k + 10, 0); }
    pen.stroke();
    this.pattern = c.createPattern(tile, "repeat");
    return this.pattern;
  }

  // Ranks where they find room, the safest first; a dot where they don't. An offer is hollow, a confirmed lift full.
  paintLifts(c) {
    const items = new Map(this.items.map((item) => [item.bundle.identity, item]));
    const open = this.data.lifts.filter((lift) => OPEN_LIFTS.includes(lift.state) && items.has(lift.bundles[0]));
    const ranked = (this.ranked = []);
    c.strokeStyle = SELECT;
    for (const lift of open.sort((a, b) => a.rank - b.rank)) {
      const item = items.get(lift.bundles[0]);
      const isOffered = lift.state === "offered";
      const wide = item.bundle.width_m * this.view.scale;
      c.lineWidth = Math.min(3.5, Math.max(1, wide / 5));
      c.fillStyle = isOffered ? OFFERED : CLAIMED;
      c.beginPath(); this.path(c, item);
      if (!isOffered || wide < NARROW_PX) c.fill();
      c.stroke();
      const [px, py] = this.place(lift.target.x_m, lift.target.y_m);
      const hasRoom = ranked.every((other) => Math.hypot(other.px - px, other.py - py) > 2 * RANK_PX + 2);
      if (hasRoom) ranked.push({ px, py, isOffered, rank: lift.rank });
      c.fillStyle = isOffered ? "#f2f2f2" : SELECT;
      c.beginPath(); c.arc(px, py, 2.5, 0, 7); c.fill(); c.stroke();
    }
    c.lineWidth = 2.5;
    c.font = "bold 14px sans-serif";
    c.textAlign = "center"; c.textBaseline = "middle";
    for (const { px, py, isOffered, rank } of ranked) {
      c.fillStyle = isOffered ? "#f2f2f2" : SELECT;
      c.beginPath(); c.arc(px, py, RANK_PX, 0, 7); c.fill(); c.stroke();
      c.fillStyle = isOffered ? "#16191b" : "#fff";
      c.fillText(String(rank), px, py + 1);
    }
  }

  // Names and words where they find room: over each bundle's lower end, first come.
  paintWords(c, seen) {
    if (this.view.scale < 9) return;
    const taken = this.ranked.map(({ px, py }) => [px - RANK_PX, py - RANK_PX, px + RANK_PX, py + RANK_PX]);
    c.textBaseline = "top";
    c.textAlign = "center";
    const clear = (box) => taken.every((o) => box[2] < o[0] || box[0] > o[2] || box[3] < o[1] || box[1] > o[3]);
    for (const item of [...seen].reverse()) {
      const [px, py] = this.place(item.x, item.low);
      const lines = [item.bundle.stock_name || item.bundle.identity];
      const chosen = item.bundle.identity === this.chosen;
      if (item.words && (chosen || this.view.scale > 25)) lines.push(item.words);
      c.font = chosen ? "bold 13px sans-serif" : "13px sans-serif";
      for (let count = lines.length; count > 0; count -= 1) {
        const width = Math.max(...lines.slice(0, count).map((line) => c.measureText(line).width)) / 2 + 3;
        let box = null;
        for (let y = py + 3; y < py + 120 && !box; y += 17) {
          const tried = [px - width, y, px + width, y + 16 * count];
          if (clear(tried)) box = tried;
        }
        if (!box) continue;
        taken.push(box);
        c.fillStyle = "#dcdddfd8";
        c.fillRect(box[0], box[1], box[2] - box[0], box[3] - box[1]);
        c.fillStyle = "#16191b";
        lines.slice(0, count).forEach((line, k) => c.fillText(line, px, box[1] + 16 * k + 1));
        break;
      }
      if (taken.length > 400 + this.ranked.length) break;
    }
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    this.moving = null;
    const [x, y] = this.at(px, py);
    this.view.scale = Math.min(2000, Math.max(1, this.view.scale * factor));
    const [nx, ny] = this.at(px, py);
    this.view.x += x - nx;
    this.view.y += y - ny;
    this.draw();
  }

  pan(px, py) {
    this.moving ||= {};
    this.view.x -= px / this.view.scale;
    this.view.y += py / this.view.scale;
    this.draw();
  }

  look(identity) {
    const item = this.items.find((each) => each.bundle.identity === identity);
    if (!item) return;
    const [px, py] = this.place(item.x, item.y);
    if (px < 40 || py < 40 || px > this.width - 40 || py > this.height - 40) Object.assign(this.view, { x: item.x, y: item.y });
    this.draw();
  }

  pick(px, py) {
    const [x, y] = this.at(px, py);
    const under = this.items.filter((i) => inside(i.corners, x, y)).sort((a, b) => b.top - a.top);
    this.onPick(under.length ? under[0].bundle.identity : null);
  }

  // One finger or the mouse moves and picks, two fingers zoom about their middle.
  listen() {
    const down = new Map();
    let moved = false;
    const spread = () => { const [[ax, ay], [bx, by]] = down.values(); return { apart: Math.hypot(ax - bx, ay - by), x: (ax + bx) / 2, y: (ay + by) / 2 }; };
    this.canvas.addEventListener("pointerdown", (e) => { moved = down.size > 0; down.set(e.pointerId, pointOf(e)); this.canvas.setPointerCapture(e.pointerId); });
    this.canvas.addEventListener("pointermove", (e) => {
      const from = down.get(e.pointerId);
      if (!from) return;
      const to = pointOf(e);
      const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
      if (!moved && Math.hypot(dx, dy) < (e.pointerType === "mouse" ? 4 : 10)) return;
      moved = true;
      const before = down.size === 2 && spread();
      down.set(e.pointerId, to);
      if (before) { const { apart, x, y } = spread(); this.zoom(apart / Math.max(before.apart, 1), x, y); }
      else if (down.size === 1) this.pan(dx, dy);
    });
    this.canvas.addEventListener("pointerup", (e) => { if (down.delete(e.pointerId) && !moved) this.pick(...pointOf(e)); });
    this.canvas.addEventListener("pointercancel", (e) => { down.delete(e.pointerId); });
    this.canvas.addEventListener("wheel", (e) => { e.preventDefault(); this.zoom(Math.exp(-e.deltaY / 400), ...pointOf(e)); }, { passive: false });
    this.canvas.addEventListener("keydown", (e) => this.key(e));
  }

  key(e) {
    const moves = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
    if (moves[e.key]) this.pan(...moves[e.key]);
    else if (e.key === "+" || e.key === "=") this.zoom(1.25);
    else if (e.key === "-") this.zoom(0.8);
    else if (e.key === "0") this.fit();
    else if (e.key === "n" || e.key === "p") this.step(e.key === "n" ? 1 : -1);
    else if (e.key === "Enter" && this.chosen) location.hash = `#bundle/${this.chosen}`;
    else if (e.key === "Escape") this.onPick(null);
    else return;
    e.preventDefault();
  }

  // The next bundle along X.
  step(by) {
    const order = [...this.items].sort((a, b) => a.x - b.x || a.y - b.y).map((item) => item.bundle.identity);
    if (!order.length) return;
    const at = order.indexOf(this.chosen);
    const next = order[(at + by + order.length + (at < 0 && by < 0 ? 1 : 0)) % order.length];
    this.onPick(next);
    this.look(next);
  }

  label() { return t("yard.canvas", this.data.bundles.length); }
}

function outline([[ax, ay], [bx, by]], width_m) {
  const length = Math.hypot(bx - ax, by - ay) || 1;
  const nx = (-(by - ay) / length) * width_m / 2;
  const ny = ((bx - ax) / length) * width_m / 2;
  return { corners: [[ax + nx, ay + ny], [bx + nx, by + ny], [bx - nx, by - ny], [ax - nx, ay - ny]] };
}

// How strongly a place is drawn: whole up to ten minutes, a third after a day.
export function fade(age_ns) {
  const minutes = Math.max(age_ns / 6e10, 10);
  return Math.max(0.33, 1 - 0.67 * (Math.log(minutes / 10) / Math.log(144)));
}

function inside(corners, x, y) {
  let sign = 0;
  for (let k = 0; k < 4; k += 1) {
    const [ax, ay] = corners[k];
    const [bx, by] = corners[(k + 1) % 4];
    const turn = Math.sign((bx - ax) * (y - ay) - (by - ay) * (x - ax));
    if (turn && sign && turn !== sign) return false;
    sign = turn || sign;
  }
  return true;
}
