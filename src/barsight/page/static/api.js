// The server: documents by name, kept until a newer revision is told; changes carry the session's token.
import { OPEN_LIFTS, t } from "./dom.js";

export const session = { name: "", role: "", token: null, rights: [], isKnown: false };
const kept = new Map();
const last = new Map(); // the newest content of each document, for the time without connection

// A moment, and how long ago it was: by the clock that goes on while a tablet sleeps, or by the one that nobody sets.
const moment = () => ({ ticks_ms: performance.now(), date_ms: Date.now() });
export const since_ms = (from) => Math.max(performance.now() - from.ticks_ms, Date.now() - from.date_ms);

// The server beats every 2 s while it judges the offers; without beats they may have ended.
const SILENT_MS = 10000;
const ANSWER_MS = 30000;
const link = { heard: moment(), isBroken: false };
export const hear = () => Object.assign(link, { heard: moment(), isBroken: false });
export const isThere = () => !link.isBroken && since_ms(link.heard) < SILENT_MS;
export const awayText = () => t("server.away", Math.round(since_ms(link.heard) / 1000));

export class Refused extends Error {
  constructor(status, problem) { super(problem); this.status = status; }
}

async function call(method, path, body) {
  const headers = {};
  if (body !== undefined) headers["Content-Type"] = "application/json";
  if (method !== "GET" && session.token) headers["X-Barsight-Token"] = session.token;
  if (!isThere() && path !== "/api/session") throw new Refused(0, awayText());
  const unanswered = () => { throw new Refused(0, t("server.unanswered")); };
  const answer = await fetch(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body), signal: AbortSignal.timeout(ANSWER_MS) }).catch(unanswered);
  const content = await answer.json().catch(() => (answer.ok ? unanswered() : {}));
  if (!answer.ok) {
    if (answer.status === 401) session.isKnown = false;
    throw new Refused(answer.status, content.problem || content.detail || answer.statusText);
  }
  return content;
}

export async function enter() {
  Object.assign(session, await call("GET", "/api/session"), { isKnown: true });
}

export async function logIn(name, password) {
  Object.assign(session, await call("POST", "/api/session", { name, password }), { isKnown: true });
}

export async function logOut() {
  await call("DELETE", "/api/session");
  session.isKnown = false;
}

export const get = (path) => call("GET", path);

// Change something. A server that was started anew has a new token: it is fetched once.
export async function change(method, path, body = {}) {
  try {
    return await call(method, path, body);
  } catch (error) {
    if (error.status !== 403) throw error;
    const before = session.token;
    await enter();
    if (session.token === before) throw error;
    return call(method, path, body);
  }
}

export function forget() { kept.clear(); }

// What may have ended isn't shown: without a connection nothing is offered, and each bundle says so.
const AWAY = { code: "no-connection", reason: "" };
const WITHOUT_OFFERS = {
  state: (one) => ({ ...one, offered: "–", claimed: "–", map_vetoes: [AWAY, ...one.map_vetoes] }),
  bundles: (one) => ({ ...one, bundles: one.bundles.map((each) => ({ ...each, lift: null, vetoes: [AWAY, ...each.vetoes] })) }),
  lifts: (one) => ({ ...one, lifts: one.lifts.filter((each) => !OPEN_LIFTS.includes(each.state)) }),
};

export async function read(name) {
  if (!isThere() && last.has(name)) return (WITHOUT_OFFERS[name] || ((one) => one))(last.get(name));
  if (!kept.has(name)) {
    const promise = call("GET", `/api/${name}`).then((content) => {
      content.read = moment();
      last.set(name, content);
      return content;
    });
    kept.set(name, promise);
    promise.catch(() => { if (kept.get(name) === promise) kept.delete(name); });
  }
  return kept.get(name);
}

export const may = (right) => session.rights.includes(right);

// Where crane and magnet of a live run are, and how it stands; null where none is watched.
export const live = { crane: null };

// Call `onRevision` at each new revision, `onCrane` when the crane moved, `onBeat` at each beat and at each end.
export function listen(onRevision, onBeat, onCrane) {
  const source = new EventSource("/api/events");
  source.addEventListener("beat", () => { hear(); onBeat(); });
  source.addEventListener("revision", (event) => onRevision(Number(event.data)));
  source.addEventListener("crane", (event) => { live.crane = JSON.parse(event.data); onCrane(); });
  source.onerror = () => { live.crane = null; link.isBroken = true; onBeat(); if (source.readyState === EventSource.CLOSED) setTimeout(() => listen(onRevision, onBeat, onCrane), 1000); };
}
