// The page: header, screens by the address's hash, the stream of revisions.
import { ageText, h, languageName, LANGUAGES, loadWords, setLanguage, show, t, tell } from "./dom.js";
import { awayText, enter, forget, hear, isThere, listen, live, logIn, read, session } from "./api.js";
import { clockNow, showCrane, yardScreen } from "./yard.js";
import { adminScreen, alarmScreen, alarmText, bundleScreen, healthScreen, liftScreen, mark, priority, stockScreen, surveyScreen } from "./screens.js";
import { targetScreen } from "./targets.js";
import { timelineScreen } from "./timeline.js";

// WebGL is on this screen only: it is loaded when it is opened.
const modelScreen = async (...given) => (await import("./model.js")).modelScreen(...given);

const SCREENS = { yard: yardScreen, model: modelScreen, bundle: bundleScreen, lifts: liftScreen, stock: stockScreen, alarms: alarmScreen, timeline: timelineScreen, surveys: surveyScreen, targets: targetScreen, health: healthScreen, admin: adminScreen };
const place = document.getElementById("screen");
let wasThere = true;
let drawn = 0;
let drawnAt = 0;
const AGED_MS = 60000; // ages stand on the screens with offers, which nothing else may draw anew for hours
const OFFERING = ["yard", "bundle", "lifts"];

const where = () => {
  const [name, argument] = location.hash.slice(1).split("/");
  return [name in SCREENS ? name : "yard", argument ? decodeURIComponent(argument) : null];
};

async function draw() {
  const mine = (drawn += 1);
  drawnAt = performance.now();
  const [name, argument] = where();
  document.body.dataset.screen = name;
  if (!session.isKnown) return logInScreen();
  try {
    const state = await read("state");
    if (mine !== drawn) return;
    header(state, name);
    await SCREENS[name](place, argument);
    document.body.dataset.shown = name;
    document.title = `${t(`nav.${name}`)} · Barsight`;
  } catch (error) {
    if (error.status === 401) logInScreen();
    else if (error.status === 404) show(place, h("section", {}, error.message));
    else if (mine === drawn && !isThere() && OFFERING.includes(name)) show(place, h("section", {}, h("h1", {}, t("veto.no-connection")), h("p", {}, error.message)));
    else tell(error.message);
  }
}

// A dialog on a lift that has changed since is left: what it asks is no longer so.
async function leaveDialog() {
  const dialog = document.querySelector("dialog[data-lift]");
  if (!dialog) return;
  const { lifts } = await read("lifts");
  if (lifts.some((one) => dialog.dataset.lift === `${one.id} ${one.state}`)) return;
  dialog.close("");
  tell(t("told.changed"));
}

function header(state, name) {
  const fact = (word, value, props = {}) => h("div", { className: "fact", ...props }, h("span", {}, t(word)), h("strong", {}, value));
  const top = state.top_alarm;
  show(document.getElementById("header"),
    fact("header.server", serverText(), { id: "server" }),
    fact(...mapAge(state), { id: "age" }),
    live.crane && fact("crane", craneText(), { id: "crane", title: live.crane.reasons.join("; ") }),
    fact("header.map", state.survey ? state.survey.map_id : "–"),
    fact("header.lifts", `${state.offered} / ${state.claimed}`),
    state.survey?.is_simulated && fact("header.kind", t("simulated")),
    h("div", { className: "last" },
      top ? h("a", { className: `alarm p${priority(top)}`, href: "#alarms", id: "top-alarm", title: alarmText(top) }, mark(top), h("span", {}, `${alarmText(top)} · ${t(`alarmstate.${top.state}`)}`)) : h("span", { className: "quiet" }, t("alarms.none")),
      h("select", { id: "language", "aria-label": t("language"), onchange: (event) => { setLanguage(event.target.value); nameSkip(); place.replaceChildren(); draw(); } },
        LANGUAGES.map((each) => h("option", { value: each, selected: each === languageName() }, { en: "English", de: "Deutsch", zh: "中文" }[each])))));
  const nav = document.getElementById("nav");
  nav.setAttribute("aria-label", t("screens"));
  show(nav, Object.keys(SCREENS).map((each) => h("a", { href: `#${each}`, id: `nav-${each}`, "aria-current": each === name ? "page" : null }, t(`nav.${each}`), each === "alarms" && state.unacknowledged > 0 && h("span", { className: "count" }, `(${state.unacknowledged})`))));
}

// The age of the map where the live crane is, else that of the newest map.
function mapAge(state) {
  const place = live.crane?.place;
  if (place) return ["header.age.here", place.map_seen_ns === null ? t("header.age.unseen") : ageText(clockNow(state) - place.map_seen_ns)];
  return ["header.age", state.survey ? ageText(clockNow(state) - state.survey.captured_to_ns) : "–"];
}

async function showAge() {
  const state = await read("state").catch(() => null);
  const fact = document.getElementById("age");
  if (!state || !fact) return;
  const [word, value] = mapAge(state);
  fact.firstChild.textContent = t(word);
  fact.lastChild.textContent = value;
}

const craneText = () => (live.crane.mode ? t(`livemode.${live.crane.mode}`) : t("crane.none"));

function craneMoved() {
  const shown = document.querySelector("#crane strong");
  if (!shown || shown.textContent !== craneText()) draw();
  showAge();
  showCrane();
}

const nameSkip = () => { document.getElementById("skip").textContent = t("skip"); };

function logInScreen() {
  show(document.getElementById("header"), h("strong", {}, "Barsight"));
  show(document.getElementById("nav"));
  if (document.getElementById("log-in")) return;
  const problem = h("p", { role: "alert" });
  const name = h("input", { id: "name", autocomplete: "username", required: true });
  const password = h("input", { id: "password", type: "password", autocomplete: "current-password", required: true });
  const go = async (event) => {
    event.preventDefault();
    try {
      await logIn(name.value, password.value);
      start();
    } catch (error) {
      problem.textContent = error.status === 401 ? t("log.in.wrong") : error.message;
    }
  };
  show(place, h("section", {}, h("h1", {}, t("log.in")), h("form", { id: "log-in", onsubmit: go }, h("label", { htmlFor: "name" }, t("name")), name, h("label", { htmlFor: "password" }, t("password")), password, h("div", { className: "buttons" }, h("button", { className: "main" }, t("log.in"))), problem)));
  name.focus();
}

let isListening = false;
function start() {
  if (!isListening) hear();
  forget();
  draw();
  if (isListening) return;
  isListening = true;
  listen(() => { forget(); changed(); }, look, craneMoved);
  setInterval(look, 1000);
}

function changed() {
  draw();
  leaveDialog().catch(() => {});
}

const serverText = () => (isThere() ? t("server.there") : awayText());

// Whether the server is there, by the last beat: while it isn't, no screen shows an offer.
function look() {
  const there = isThere();
  const text = document.querySelector("#server strong");
  if (text) text.textContent = serverText();
  if (there === wasThere) return;
  wasThere = there;
  document.body.dataset.there = there;
  if (there) {
    forget();
    enter().catch(() => {}).then(changed);
  } else if (OFFERING.includes(where()[0])) changed();
}

setInterval(async () => {
  if (!session.isKnown || !isThere()) return;
  await showAge();
  const name = where()[0];
  if (name === "health" || (OFFERING.includes(name) && performance.now() - drawnAt > AGED_MS)) draw();
}, 5000);
window.addEventListener("hashchange", () => draw().then(() => place.focus()));
await loadWords();
nameSkip();
enter().then(start, logInScreen);
