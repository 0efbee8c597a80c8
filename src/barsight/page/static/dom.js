// Elements, words, figures: what every screen uses.
let catalogue = {};
let language = 0;
export const LANGUAGES = ["en", "de", "zh"];

export async function loadWords() {
  catalogue = await (await fetch("/static/words.json")).json();
  const kept = localStorage.getItem("barsight.language") || navigator.language.slice(0, 2);
  setLanguage(LANGUAGES.includes(kept) ? kept : "en");
}

export function setLanguage(name) {
  language = LANGUAGES.indexOf(name);
  localStorage.setItem("barsight.language", name);
  document.documentElement.lang = name;
}

export const languageName = () => LANGUAGES[language];

// A word of the catalogue; {0}, {1} stand for what is given.
export function t(key, ...given) {
  const words = catalogue[key];
  if (!words) return key;
  return words[language].replace(/\{(\d)\}/g, (_, k) => given[k]);
}

export const known = (key) => key in catalogue;

export function h(tag, props = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element && !["list", "role"].includes(name)) element[name] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

// Exchange what a place shows; whoever had the focus keeps it, by id.
export function show(place, ...children) {
  const focused = document.activeElement && place.contains(document.activeElement) ? document.activeElement.id : "";
  place.replaceChildren(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  if (focused) document.getElementById(focused)?.focus({ preventScroll: true });
}

// Pixels of the screen for each of a canvas's; a wall screen shows everything larger.
export const pixelRatio = (canvas) => (window.devicePixelRatio || 1) * (canvas.currentCSSZoom || 1);

// Where on a canvas a pointer is, in the canvas's pixels.
export function pointOf(event) {
  const canvas = event.currentTarget;
  const box = canvas.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top].map((px) => (px * canvas.clientWidth) / box.width);
}

export const OPEN_LIFTS = ["offered", "claimed", "executing"];
export const metres = (value, digits = 2) => (value === null || value === undefined ? "–" : `${value.toFixed(digits)} m`);
export const figure = (value, sigma, factor, unit, digits = 0) => {
  if (value === null || value === undefined) return t("unknown");
  const spread = sigma === null || sigma === undefined ? "" : ` ± ${(sigma * factor).toFixed(digits)}`;
  return `${(value * factor).toFixed(digits)}${spread} ${unit}`;
};

export function ageText(ns) {
  const seconds = Math.max(0, ns / 1e9);
  if (seconds < 90) return t("age.s", Math.round(seconds));
  if (seconds < 5400) return t("age.min", Math.round(seconds / 60));
  if (seconds < 172800) return t("age.h", (seconds / 3600).toFixed(1));
  return t("age.d", Math.round(seconds / 86400));
}

export const timeText = (ns) => new Date(ns / 1e6).toISOString().slice(0, 19).replace("T", " ") + " UTC";

export function tell(text) {
  const place = document.getElementById("told");
  place.textContent = text;
  clearTimeout(tell.timer);
  tell.timer = setTimeout(() => { place.textContent = ""; }, 6000);
}

// Ask in a dialog; returns the form's values, or null where it was left. fields: [name, label, options].
// lift: the one that is asked about; the dialog is left where its state changes.
export function ask(title, text, fields, accept, lift = null) {
  return new Promise((resolve) => {
    const inputs = fields.map(([name, label, options = {}]) => [
      h("label", { htmlFor: `ask-${name}` }, label),
      options.choices
        ? h("select", { id: `ask-${name}`, name }, options.choices.map(([value, word]) => h("option", { value }, word)))
        : h("input", { id: `ask-${name}`, name, className: "wide", autocomplete: "off", required: true, ...options }),
    ]);
    const form = h("form", { method: "dialog", onsubmit: () => dialog.close("yes") },
      h("h1", { id: "ask-title" }, title), text && h("div", {}, text), inputs,
      h("div", { className: "buttons" }, h("button", { className: "main", id: "ask-yes" }, accept),
        h("button", { type: "button", onclick: () => dialog.close("") }, t("cancel"))));
    const dialog = h("dialog", { "aria-labelledby": "ask-title", "data-lift": lift && `${lift.id} ${lift.state}`, onclose: () => {
      const values = Object.fromEntries(new FormData(form));
      dialog.remove();
      resolve(dialog.returnValue === "yes" ? values : null);
    } }, form);
    document.body.append(dialog);
    dialog.showModal();
  });
}

export const table = (heads, rows, label) => h("table", { "aria-label": label },
  h("thead", {}, h("tr", {}, heads.map((head) => h("th", { className: head.startsWith("#") ? "n" : "", scope: "col" }, head.replace("#", ""))))),
  h("tbody", {}, rows));
export const row = (cells, props = {}) => h("tr", props, cells.map((cell) => (cell instanceof HTMLTableCellElement ? cell
  : h("td", { className: typeof cell === "string" && /^[-–\d]/.test(cell) ? "n" : "" }, cell))));
