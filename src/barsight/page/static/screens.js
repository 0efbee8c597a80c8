// Screens beside the yard: bundle, lifts, stock, alarms, surveys, health, administration.
import { OPEN_LIFTS, ask, h, known, metres, row, show, t, table, tell, timeText, ageText } from "./dom.js";
import { change, get, logOut, may, read, session } from "./api.js";
import { clockNow, figures, liftButtons, liftPanel } from "./yard.js";
import { shortWhys, vetoText, whyNot } from "./why.js";

const act = (method, path, body, word) => change(method, path, body).then((given) => { tell(t(word)); return given; }, (error) => { tell(error.message); return null; });

export async function bundleScreen(place, name) {
  const [{ bundles }, { lifts }, state] = await Promise.all([read("bundles"), read("lifts"), read("state")]);
  if (!name) {
    const rows = bundles.map((one) => row([
      h("td", {}, h("a", { href: `#bundle/${one.identity}`, id: `see-${one.identity}` }, one.identity)), h("td", {}, one.stock_name || "–"),
      one.axis_centre_m[0].toFixed(2), one.axis_centre_m[1].toFixed(2), one.top_z_m.toFixed(2), `${one.length_m.toFixed(2)}${one.ends_open.some(Boolean) ? "+" : ""}`,
      ageText(clockNow(state) - one.seen_ns),
      h("td", {}, one.lift ? t(`lift.${one.lift.state}`) : one.doubt ? vetoText(`doubt-${one.doubt.code}`) : shortWhys(one, state.map_vetoes)),
    ]));
    return show(place, h("section", {}, h("h1", {}, t("bundles")), table([t("bundle"), t("stock.name"), "#X m", "#Y m", `#${t("top")} m`, `#${t("length")} m`, `#${t("seen")}`, t("lift.or.why")], rows, t("bundles"))));
  }
  const bundle = bundles.find((one) => one.identity === name);
  const told = await get(`/api/bundles/${encodeURIComponent(name)}`);
  const lift = bundle?.lift && lifts.find((one) => one.id === bundle.lift.id);
  const pictures = told.history.filter((one) => !one.reason).slice(-6).reverse().map((one) => h("figure", {},
    h("img", { className: "shot", src: `/api/bundles/${name}/pictures/${one.map_id}.png`, alt: t("picture", one.map_id), onerror: (event) => event.target.closest("figure").remove() }),
    h("figcaption", { className: "small quiet" }, `${t("picture", one.map_id)} · ${timeText(one.at_ns)}`)));
  show(place,
    h("div", { className: "two" },
      h("section", {}, h("h1", {}, name), bundle ? figures(bundle, clockNow(state)) : h("p", {}, t("bundle.gone")),
        h("h2", {}, t("stock.entry")), h("p", {}, bundle?.stock_name || t("stock.none"))),
      h("div", {}, bundle && h("section", {}, h("h1", {}, lift ? t("lift") : t("why.not")), lift ? liftPanel(lift, clockNow(state)) : whyNot(bundle, state.map_vetoes)),
        h("section", { id: "pictures" }, h("h1", {}, t("pictures")), pictures))),
    h("section", {}, h("h1", {}, t("history")), table([t("time"), t("what"), "#X m", "#Y m", `#${t("top")} m`, t("map")], [...told.history].reverse().map((one) => row([
      h("td", {}, timeText(one.at_ns)), h("td", {}, t(`change.${one.what}`), one.reason && h("div", { className: "quiet small" }, one.reason)), one.x_m?.toFixed(3) ?? "–", one.y_m?.toFixed(3) ?? "–", one.top_z_m?.toFixed(3) ?? "–",
      h("td", {}, one.map_id)])), t("history")),
    told.lifts.length > 0 && [h("h2", {}, t("lifts")), told.lifts.map((one) => stepsOf(one))]));
}

const stepsOf = (one) => h("div", { className: "small" }, h("strong", {}, `${t("lift")} ${one.id} (${one.map_id})`), h("ul", {}, one.steps.map((step) => h("li", {}, `${timeText(step.at_ns)} · ${t(`lift.${step.state}`)} · ${step.who}${step.note ? ` · ${step.note}` : ""}`))));

export async function liftScreen(place) {
  const [{ lifts }, state] = await Promise.all([read("lifts"), read("state")]);
  const open = lifts.filter((one) => OPEN_LIFTS.includes(one.state)).sort((a, b) => a.rank - b.rank);
  const closed = lifts.filter((one) => !open.includes(one));
  show(place,
    h("section", {}, h("h1", {}, t("lifts.open")), open.length ? h("div", { className: "lifts" }, open.map((one) => h("div", { className: "panel", id: `lift-${one.id}` }, h("h2", {}, `${one.rank} · ${one.bundles.join(", ")}`), liftPanel(one, clockNow(state))))) : h("p", {}, t("lifts.none"))),
    h("section", {}, h("h1", {}, t("lifts.closed")), table([t("lift"), t("bundle"), t("state"), t("time"), t("who"), t("note"), t("to.do")], closed.map((one) => {
      const step = one.steps[one.steps.length - 1];
      return row([h("td", {}, String(one.id)), h("td", {}, one.bundles.map((name) => h("a", { href: `#bundle/${name}` }, name))), h("td", {}, t(`lift.${one.state}`)), h("td", {}, timeText(step.at_ns)), h("td", {}, step.who), h("td", {}, step.note || ""), h("td", {}, liftButtons(one, clockNow(state)))]);
    }), t("lifts.closed"))));
}

export async function stockScreen(place) {
  const stock = await read("stock");
  const written = h("p", {}, h("a", { href: "/api/stock.csv", download: "stock.csv", id: "stock-list" }, t("stock.write")));
  if (stock.list === null) return show(place, h("section", {}, h("h1", {}, t("stock")), h("p", {}, t(stock.map_id ? "stock.no.list" : "yard.empty")), stock.map_id && written));
  const decide = async (each, decision) => {
    const given = await ask(t(`stock.${decision}`), each.key, [["note", t("reason"), { required: false }]], t("accept"));
    if (given) act("POST", "/api/stock", { map_id: stock.map_id, key: each.key, decision, note: given.note }, "told.decided");
  };
  const rows = stock.differences.map((each, k) => row([
    h("td", {}, t(`stock.kind.${each.kind}`)), h("td", {}, each.name || "–"), h("td", {}, each.bundle ? h("a", { href: `#bundle/${each.bundle}` }, each.bundle) : "–"),
    h("td", {}, each.moved_m ? each.moved_m.map((value) => metres(value)).join(" / ") : (each.says || []).join("; ")),
    h("td", {}, each.decision && [h("strong", {}, t(`stock.${each.decision.what}`)), h("div", { className: "small quiet" }, `${each.decision.who} · ${timeText(each.decision.at_ns)}${each.decision.note ? ` · ${each.decision.note}` : ""}`)]),
    h("td", {}, h("div", { className: "buttons" }, h("button", { id: `accept-${k}`, disabled: !may("operate"), onclick: () => decide(each, "accepted") }, t("stock.accept")), h("button", { id: `reject-${k}`, disabled: !may("operate"), onclick: () => decide(each, "rejected") }, t("stock.reject")))),
  ]));
  show(place, h("section", {}, h("h1", {}, t("stock")), h("p", {}, t("stock.summary", stock.agree.length, stock.differences.length, stock.map_id)), h("p", { className: "quiet small" }, t("stock.help")), written, table([t("stock.kind"), t("stock.name"), t("bundle"), t("what"), t("stock.decision"), t("to.do")], rows, t("stock"))));
}

export const priority = (alarm) => alarm.priority;
export const alarmText = (alarm) => `${known(`alarm.${alarm.code}`) ? t(`alarm.${alarm.code}`) : alarm.code}: ${alarm.reason}`;
export const mark = (alarm) => h("span", { className: `mark ${alarm.state === "cleared" ? "done" : `p${priority(alarm)}`}`, title: t("priority", priority(alarm)) }, String(priority(alarm)));

export async function alarmScreen(place) {
  const { alarms } = await read("alarms");
  const acknowledge = (alarm) => act("POST", `/api/alarms/${alarm.id}/acknowledge`, { note: "" }, "told.acknowledged");
  const line = (alarm) => {
    const known_ = known(`cause.${alarm.code}`);
    return row([
      h("td", {}, mark(alarm), h("strong", {}, alarmText(alarm)), known_ && h("div", { className: "small" }, `${t("cause")}: ${t(`cause.${alarm.code}`)}`), known_ && h("div", { className: "small" }, `${t("action")}: ${t(`action.${alarm.code}`)}`)),
      h("td", {}, t(`alarmstate.${alarm.state}`)),
      h("td", { className: "small" }, alarm.steps.map((step) => h("div", {}, `${timeText(step.at_ns)} · ${t(`alarmstate.${step.state}`)} · ${step.who}${step.note ? ` · ${step.note}` : ""}`))),
      h("td", {}, ["raised", "returned"].includes(alarm.state) && h("button", { id: `ack-${alarm.id}`, disabled: !may("operate"), onclick: () => acknowledge(alarm) }, t("acknowledge"))),
    ]);
  };
  const sorted = [...alarms].sort((a, b) => (a.state === "cleared") - (b.state === "cleared"));
  const heads = [t("alarm"), t("state"), t("history"), t("to.do")];
  const open = sorted.filter((one) => one.state !== "cleared");
  show(place, h("section", {}, h("h1", {}, t("alarms.active", open.length)), open.length ? table(heads, open.map(line), t("alarms")) : h("p", {}, t("alarms.none")), h("p", { className: "quiet small" }, t("alarms.veto"))),
    h("section", {}, h("h1", {}, t("alarms.past")), table(heads, sorted.filter((one) => one.state === "cleared").slice(0, 100).map(line), t("alarms.past"))));
}

export async function surveyScreen(place) {
  const [{ surveys }, { recordings }] = await Promise.all([read("surveys"), read("equipment")]);
  const kinds = ["same", "moved", "added", "found", "gone", "covered", "not-found"];
  const rows = surveys.map((one) => row([
    h("td", {}, one.map_id, one.is_simulated && h("div", { className: "small" }, t("simulated"))), h("td", {}, timeText(one.captured_to_ns)),
    ...kinds.map((kind) => h("td", { className: "n" }, String(one.changes[kind] || 0))),
    h("td", {}, one.files.includes("report.html") ? h("a", { href: `/api/surveys/${one.map_id}/files/report.html`, target: "_blank", rel: "noopener", id: `report-${one.map_id}` }, t("report")) : "–"),
    h("td", {}, h("details", {}, h("summary", {}, t("files", one.files.length)), h("ul", { className: "plain small" }, one.files.map((name) => h("li", {}, h("a", { href: `/api/surveys/${one.map_id}/files/${name}`, download: name }, name)))), one.missing.length > 0 && h("p", { className: "small" }, t("files.missing", one.missing.join(", "))), h("p", { className: "small quiet" }, one.folder))),
  ]));
  show(place, h("section", {}, h("h1", {}, t("surveys")), table([t("map"), t("last.frame"), ...kinds.map((kind) => `#${t(`change.${kind}`)}`), t("report"), t("files.head")], rows, t("surveys"))),
    h("section", {}, h("h1", {}, t("recordings")), table([t("recording"), "SHA-256", t("rig"), t("state"), t("recording.why"), t("map")], recordings.map((one) => row([
      h("td", { className: "long" }, one.key), h("td", {}, h("code", { title: one.digest }, one.digest.slice(0, 12))), h("td", {}, one.rig || "–"), h("td", {}, t(`recording.${one.state}`)),
      h("td", {}, one.state === "kept" ? one.note : "–", h("div", { className: "small quiet" }, `${one.who} · ${timeText(one.at_ns)}`)), h("td", {}, one.surveys.join(", ") || "–")])), t("recordings"))));
}

function calibrationSection(calibrations, clock_ns) {
  const approve = async (digest) => {
    const fields = [["until", t("calibration.until.date"), { type: "date", required: false }], ["note", t("note"), { required: false }]];
    const given = await ask(t("calibration.approve"), h("p", {}, t("calibration.approve.text", digest)), fields, t("calibration.approve"));
    const until_ns = given?.until ? Date.parse(`${given.until}T00:00:00Z`) * 1e6 : null;
    if (given) act("POST", "/api/calibrations", { digest, until_ns, note: given.note }, "told.approved");
  };
  const standing = (time) => (clock_ns < time.from_ns ? "to.come" : time.until_ns !== null && clock_ns >= time.until_ns ? "ended" : "valid");
  const rows = calibrations.flatMap((one) => (one.times.length ? one.times : [null]).map((time, k) => row([
    h("td", {}, one.crane), h("td", {}, one.rig), h("td", {}, one.digest), h("td", {}, t(time ? `calibration.${standing(time)}` : "calibration.never")),
    h("td", {}, time ? timeText(time.from_ns) : "–"), h("td", {}, time?.until_ns ? timeText(time.until_ns) : "–"),
    h("td", {}, time ? time.approved_by : "–", time?.note && h("div", { className: "small quiet" }, time.note)),
    h("td", {}, k === 0 && h("button", { id: `approve-${one.digest}`, disabled: !may("administer"), onclick: () => approve(one.digest) }, t("calibration.approve")))])));
  const heads = ["crane", "rig", "calibration", "state", "calibration.from", "calibration.until", "calibration.by", "to.do"].map((word) => t(word));
  return h("section", { id: "calibrations" }, h("h1", {}, t("calibrations")), h("p", { className: "quiet small" }, t("calibrations.help")), table(heads, rows, t("calibrations")));
}

const curve = (values, label) => {
  const high = Math.max(...values, 1e-9);
  const points = values.map((value, k) => `${k ? "L" : "M"}${(1000 * k) / Math.max(values.length - 1, 1)},${100 - (90 * value) / high}`).join("");
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 1000 110");
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", label);
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", points);
  path.setAttribute("vector-effect", "non-scaling-stroke");
  svg.append(path);
  return [h("h2", {}, `${label}: ${values.length ? values[values.length - 1] : "–"} (${t("largest")} ${high})`), svg];
};

export async function healthScreen(place) {
  const [health, { calibrations }, state] = await Promise.all([get("/api/health"), read("equipment"), read("state")]);
  const pairs = [[t("store"), health.store], [t("revision"), String(health.revision)], [t("problem"), health.problem || t("none")]];
  const live = health.live;
  show(place, h("section", {}, h("h1", {}, t("health")), h("dl", {}, pairs.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]))),
    calibrationSection(calibrations, clockNow(state)),
    h("section", {}, h("h1", {}, t("live")), !live ? h("p", {}, t("live.none")) : !live.content ? h("p", {}, t("alarm.live-stopped")) : [
      h("dl", {}, [[t("mode"), live.content.mode], [t("age"), ageText(live.age_s * 1e9)],
        ...Object.entries(live.content.rates_hz).map(([name, value]) => [name, `${value} Hz`]),
        ...Object.entries(live.content.frames.dropped).map(([name, value]) => [`${t("dropped")}: ${name}`, String(value)]),
        ...Object.entries(live.content.restarts).map(([name, value]) => [`${t("restarts")}: ${name}`, String(value)]),
        ...Object.entries(live.content.memory_bytes).map(([name, value]) => [`${t("memory")}: ${name}`, `${(value / 2 ** 20).toFixed(0)} MiB`])].map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)])),
      ["tracked", "mapped"].map((name) => curve(health.trend.map((one) => one.rates_hz[name] || 0), `${name} Hz`)), curve(health.trend.map((one) => one.backlog), t("backlog"))]));
}

export async function adminScreen(place) {
  const own = h("section", {}, h("h1", {}, t("admin")), h("p", {}, `${session.name} · ${t(`role.${session.role}`)}`), session.name !== "local" && h("button", { id: "log-out", onclick: () => logOut().then(() => location.reload()) }, t("log.out")));
  if (!may("administer")) return show(place, own, h("section", {}, h("p", {}, t("admin.not"))));
  const { accounts } = await get("/api/accounts");
  const choices = ["viewer", "operator", "engineer", "service"].map((role) => [role, t(`role.${role}`)]);
  const add = async (kind) => {
    const fields = [["name", t("name")], ["role", t("role"), { choices: accounts.length ? choices : choices.filter(([role]) => role === "engineer") }]];
    if (kind === "person") fields.push(["password", t("password"), { type: "password", minLength: 10, autocomplete: "new-password" }]);
    const given = await ask(t(`admin.add.${kind}`), null, fields, t("accept"));
    const made = given && (await act("POST", "/api/accounts", { ...given, kind }, "told.account"));
    if (made?.token) ask(t("admin.token"), h("p", {}, t("admin.token.once"), h("br"), h("code", { id: "new-token" }, made.token)), [], "OK");
  };
  const remove = async (one) => (await ask(t("admin.remove"), one.name, [], t("accept"))) && act("DELETE", `/api/accounts/${encodeURIComponent(one.name)}`, {}, "told.account");
  show(place, own, h("section", {}, h("h1", {}, t("accounts")), !accounts.length && h("p", {}, t("admin.open")),
    table([t("name"), t("kind"), t("role"), t("to.do")], accounts.map((one) => row([h("td", {}, one.name), h("td", {}, t(`kind.${one.kind}`)), h("td", {}, t(`role.${one.role}`)), h("td", {}, h("button", { id: `remove-${one.name}`, onclick: () => remove(one) }, t("admin.remove")))])), t("accounts")),
    h("div", { className: "buttons" }, h("button", { id: "add-person", onclick: () => add("person") }, t("admin.add.person")), h("button", { id: "add-token", disabled: !accounts.length, onclick: () => add("token") }, t("admin.add.token")))),
  h("section", {}, h("h1", {}, t("forbid")), h("p", {}, t("forbid.text")), h("button", { id: "forbid", onclick: async () => {
    const given = await ask(t("forbid"), t("forbid.text"), [["code", t("veto.code"), { choices: ["calibration-changed", "disturbed", "trajectory-degraded", "units-doubtful"].map((code) => [code, vetoText(code)]) }], ["reason", t("reason")]], t("forbid"));
    if (given) act("POST", "/api/vetoes", given, "told.forbidden");
  } }, t("forbid"))));
}
