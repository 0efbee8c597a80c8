// Why a bundle is not offered, and what would help.
import { h, known, t } from "./dom.js";

const direction = (from, to) => {
  const x = to[0] - from[0];
  const y = to[1] - from[1];
  return Math.abs(x) > Math.abs(y) ? (x > 0 ? "+X" : "-X") : y > 0 ? "+Y" : "-Y";
};

const BEYOND_M = 0.3; // so much more than the missing length, for the end to be in view

// For an open end: towards where it lies, on which axis of the crane, and how far where bars alike tell.
export function helpOf(code, bundle) {
  if (code === "end-open" && bundle.ends_open.some(Boolean)) {
    const ways = bundle.ends_open.map((open, k) => (open ? direction(bundle.axis_centre_m, bundle.ends_m[k]) : null)).filter(Boolean);
    const axis = (way) => (way.endsWith("Y") ? "help.trolley" : "help.bridge");
    if (ways.length === 1 && bundle.unseen_m !== null) return t(`${axis(ways[0])}.by`, ways[0], (bundle.unseen_m + BEYOND_M).toFixed(1));
    return ways.map((way) => t(axis(way), way)).join(" ");
  }
  return known(`help.${code}`) ? t(`help.${code}`) : "";
}

export const vetoText = (code) => (known(`veto.${code}`) ? t(`veto.${code}`) : code);

const entry = (code, reason, help) => h("div", { className: "why" }, h("strong", {}, vetoText(code)),
  help && h("div", { className: "help" }, help), h("div", { className: "reason" }, reason ? `${code}: ${reason}` : code));

export function whyNot(bundle, mapVetoes) {
  const seen = new Set();
  const told = [...mapVetoes, ...bundle.vetoes].filter((veto) => !seen.has(veto.code + veto.reason) && seen.add(veto.code + veto.reason));
  const entries = told.map((veto) => entry(veto.code, veto.reason, helpOf(veto.code, bundle)));
  if (bundle.doubt) entries.unshift(entry(`doubt-${bundle.doubt.code}`, bundle.doubt.reason, t(`help.doubt-${bundle.doubt.code}`)));
  if (!entries.length && !bundle.lift) entries.push(h("p", {}, t("why.none")));
  return entries;
}

// Short words for the list of bundles: all reasons, each once.
export const shortWhys = (bundle, mapVetoes) => [...new Set([...mapVetoes, ...bundle.vetoes].map((veto) => known(`short.${veto.code}`) ? t(`short.${veto.code}`) : veto.code))].join(", ") || t("why.none");

// Short words for the drawing: why it is not offered.
export function shortWhy(bundle) {
  if (bundle.lift) return "";
  if (bundle.doubt) return vetoText(`doubt-${bundle.doubt.code}`);
  return bundle.vetoes.length ? t("short." + bundle.vetoes[0].code) : "";
}
export const isForbidden = (bundle) => !bundle.lift && (bundle.vetoes.length > 0 || bundle.doubt !== null);
