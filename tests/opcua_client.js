// A client of node-opcua against the OPC UA server: walks, judges nothing, and prints what it saw as JSON.
// node opcua_client.js CONFIG.json; asks its test for changes of the plant by lines {"ask": ...}.
"use strict";
const fs = require("fs");
const crypto = require("crypto");
const readline = require("readline");
const ua = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const config = JSON.parse(fs.readFileSync(process.argv[2], "utf8"));
const lines = readline.createInterface({ input: process.stdin })[Symbol.asyncIterator]();
const BASE = "Objects/VisionSystem";
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

async function ask(what) {
    console.log(JSON.stringify({ ask: what }));
    return (await lines.next()).value;
}

function client(who, secured = true, extra = {}) {
    return ua.OPCUAClient.create({
        applicationName: "tests", applicationUri: config.uri, endpointMustExist: false,
        securityMode: secured ? ua.MessageSecurityMode.SignAndEncrypt : ua.MessageSecurityMode.None,
        securityPolicy: secured ? ua.SecurityPolicy.Basic256Sha256 : ua.SecurityPolicy.None,
        certificateFile: who.certificate, privateKeyFile: who.key,
        clientCertificateManager: manager, connectionStrategy: { maxRetry: 0, initialDelay: 100 },
        requestedSessionTimeout: 20000, keepSessionAlive: false, ...extra,
    });
}
let manager;

async function session(who, user, secured = true) {
    const one = client(who, secured);
    try {
        await one.connect(config.url);
        const identity = user ? { type: ua.UserTokenType.UserName, userName: user[0], password: user[1] }
            : { type: ua.UserTokenType.Anonymous };
        return { client: one, session: await one.createSession(identity) };
    } catch (error) {
        await one.disconnect().catch(() => {});
        throw error;
    }
}

async function refused(who, user, secured) {
    try {
        const got = await session(who, user, secured);
        await got.client.disconnect();
        return "let in";
    } catch (error) {
        return error.message;
    }
}

async function find(s, start, path) {
    const found = await s.translateBrowsePath(ua.makeBrowsePath(start, path));
    if (!found.targets || !found.targets.length) throw new Error(`${path}: ${found.statusCode.name}`);
    return found.targets[0].targetId;
}

async function call(s, object, method, inputs) {
    const answer = await s.call({ objectId: object, methodId: method, inputArguments: inputs || [] });
    return { status: answer.statusCode.name, outputs: answer.outputArguments || [] };
}

async function names(s, node, reference, direction = ua.BrowseDirection.Forward) {
    const got = await s.browse({
        nodeId: node, referenceTypeId: reference, browseDirection: direction, includeSubtypes: true, resultMask: 63,
    });
    return got.references;
}

// The specification's own table, as the server's types tell it: transitions with causes.
async function table(s, ns) {
    const rows = [];
    for (const type of [1017, 1021]) {
        for (const child of await names(s, `ns=${ns};i=${type}`, "HasComponent")) {
            if (child.typeDefinition.toString() !== "ns=0;i=2310") continue;
            const ends = {};
            for (const [key, reference] of [["from", "i=51"], ["to", "i=52"], ["causes", "i=53"], ["effects", "i=54"]])
                ends[key] = (await names(s, child.nodeId, reference)).map((one) => one.browseName.name);
            rows.push({ name: child.browseName.name, ...ends });
        }
    }
    return rows;
}

class Machine {
    constructor(s, ns) { this.s = s; this.ns = ns; }
    async learn() {
        const [s, ns] = [this.s, this.ns];
        this.system = await find(s, "ObjectsFolder", `/${config.index}:VisionSystem`);
        this.main = await find(s, this.system, `/${ns}:VisionStateMachine`);
        this.auto = await find(s, this.main, `/${ns}:AutomaticModeStateMachine`);
        this.recipes = await find(s, this.system, `/${ns}:RecipeManagement`);
        this.results = await find(s, this.system, `/${ns}:ResultManagement`);
        this.states = await Promise.all([this.main, this.auto].map((one) => find(s, one, "/CurrentState")));
        this.ids = await Promise.all([this.main, this.auto].map((one) => find(s, one, "/CurrentState.Id")));
        this.numbers = await Promise.all([this.main, this.auto].map((one) => find(s, one, "/CurrentState.Number")));
        const cause = () => [{ dataType: ua.DataType.Int32, value: 0 }, { dataType: ua.DataType.String, value: "test" }];
        const structure = async (type, fields) => ({
            dataType: ua.DataType.ExtensionObject,
            value: await s.constructExtensionObject(ua.resolveNodeId(`ns=${ns};i=${type}`), fields),
        });
        this.structure = structure;
        const recipe = async () => [await structure(3002, { id: "" }), await structure(3013, { id: "bars/magnet-1" })];
        const job = async () => [
            await structure(3015, { id: "" }), await structure(3004, { id: "" }), await structure(3002, { id: "" }),
            await structure(3003, { id: "" }),
            { dataType: ua.DataType.Variant, arrayType: ua.VariantArrayType.Array, value: [] },
        ];
        this.methods = {
            Halt: [this.main, cause], Reset: [this.main, cause], SelectModeAutomatic: [this.main, () => []],
            PrepareRecipe: [this.recipes, recipe], UnprepareRecipe: [this.recipes, recipe],
            StartSingleJob: [this.auto, job], StartContinuous: [this.auto, job], Stop: [this.auto, cause],
            Abort: [this.auto, cause],
        };
        this.nodes = {};
        for (const [name, [object]] of Object.entries(this.methods))
            this.nodes[name] = await find(s, object, `/${ns}:${name}`);
    }
    async do(name, s = this.s) {
        return call(s, this.methods[name][0], this.nodes[name], await this.methods[name][1]());
    }
    async state() {
        const values = await this.s.read([...this.states, ...this.ids, ...this.numbers].map((nodeId) => ({ nodeId, attributeId: 13 })));
        const told = values.map((one) => one.statusCode.name === "Good" ? (one.value.value.text || one.value.value.toString()) : null);
        return { main: told[0], automatic: told[1], ids: [told[2], told[3]], numbers: [told[4], told[5]] };
    }
}

const PATHS = {
    Preoperational: [], Halted: ["Halt"], Initialized: ["SelectModeAutomatic"],
    Ready: ["SelectModeAutomatic", "PrepareRecipe"],
    SingleExecution: ["SelectModeAutomatic", "PrepareRecipe", "StartSingleJob"],
    ContinuousExecution: ["SelectModeAutomatic", "PrepareRecipe", "StartContinuous"],
};

async function transitions(m) {
    const seen = [];
    for (const [start, path] of Object.entries(PATHS)) {
        for (const method of Object.keys(m.methods)) {
            await m.do("Halt");
            await m.do("Reset");
            for (const step of path) await m.do(step);
            const before = await m.state();
            const { status } = await m.do(method);
            seen.push({ start, method, status, before, after: await m.state() });
        }
    }
    return seen;
}

const FIELDS = ["EventType", "SourceName", "Message", "Severity", "EventId", "FromState", "ToState", "Transition.Number",
    "JobId", "ResultId", "ResultState", "ResultContent", "InternalId", "ConditionName", "ActiveState.Id",
    "AckedState.Id", "Retain", "Comment", "ClientUserId"];

async function watch(s, ns) {
    const vision = new Set(["JobId", "ResultId", "ResultState", "ResultContent", "InternalId"]);
    const filter = new ua.EventFilter({
        selectClauses: [...FIELDS.map((name) => new ua.SimpleAttributeOperand({
            typeDefinitionId: "i=2041", attributeId: 13,
            browsePath: name.split(".").map((one) => ({ namespaceIndex: vision.has(one) ? ns : 0, name: one })),
        })), new ua.SimpleAttributeOperand({ typeDefinitionId: "i=2782", attributeId: 1, browsePath: [] })],
        whereClause: { elements: [] },
    });
    const subscription = await s.createSubscription2({
        requestedPublishingInterval: 50, requestedLifetimeCount: 200, requestedMaxKeepAliveCount: 20,
        maxNotificationsPerPublish: 0, publishingEnabled: true, priority: 1,
    });
    const events = [];
    const item = await subscription.monitor({ nodeId: "i=2253", attributeId: 12 },
        { samplingInterval: 0, filter, queueSize: 1000, discardOldest: true }, ua.TimestampsToReturn.Both);
    item.on("changed", (fields) => {
        const one = {};
        [...FIELDS, "ConditionId"].forEach((name, at) => { one[name] = fields[at] && fields[at].value; });
        events.push(one);
    });
    return { events, subscription };
}

async function until(test, ms = 5000) {
    for (const end = Date.now() + ms; Date.now() < end; await sleep(20)) {
        const found = test();
        if (found) return found;
    }
    return null;
}

const plain = (event) => event && {
    ...event, EventType: event.EventType.toString(), EventId: event.EventId.toString("hex"),
    ConditionId: event.ConditionId && event.ConditionId.toString(),
    ResultContent: event.ResultContent && event.ResultContent.map((one) => one.value || one),
};

async function job(m, s) {
    await m.do("Halt"); await m.do("Reset"); await m.do("SelectModeAutomatic"); await m.do("PrepareRecipe");
    const watching = await watch(s, m.ns);
    const started = await m.do("StartSingleJob");
    await ask(`survey survey-7 ${config.result}`);
    const ready = await until(() => watching.events.find((one) => one.ResultContent));
    const id = await m.structure(3021, { id: "survey-7" });
    const timeout = { dataType: ua.DataType.Int32, value: 1000 };
    const get = await call(s, m.results, await find(s, m.results, `/${m.ns}:GetResultById`), [id, timeout]);
    const transfer = await find(s, m.results, `/${m.ns}:ResultTransfer`);
    const options = await m.structure(3022, { id: { id: "survey-7" } });
    const file = await call(s, transfer, await find(s, transfer, "/GenerateFileForRead"), [options]);
    const node = file.outputs[0].value, handle = { dataType: ua.DataType.UInt32, value: file.outputs[1].value };
    const pieces = [];
    const read = await find(s, node, "/Read");
    for (;;) {
        const piece = await call(s, node, read, [handle, { dataType: ua.DataType.Int32, value: 65536 }]);
        if (!piece.outputs.length || !piece.outputs[0].value || !piece.outputs[0].value.length) break;
        pieces.push(piece.outputs[0].value);
    }
    const closed = await call(s, node, await find(s, node, "/Close"), [handle]);
    const after = await m.state();
    await sleep(200);
    await watching.subscription.terminate();
    const result = get.outputs[1] && get.outputs[1].value;
    return {
        started: [started.status, started.outputs[0].value.id], ready: plain(ready), get: get.status,
        content: result && result.resultContent.map((one) => one.value || one), job: result && result.jobId.id,
        simulated: result && result.isSimulated, sha256: crypto.createHash("sha256").update(Buffer.concat(pieces)).digest("hex"),
        closed: closed.status, after, events: watching.events.map(plain),
    };
}

async function alarm(m, s, viewer) {
    const watching = await watch(s, m.ns);
    await ask("alarm calibration-drift error");
    const raised = await until(() => watching.events.find((one) => one.ConditionName));
    await sleep(200);
    const inError = await m.state();
    const acknowledge = (who, eventId) => call(who, raised.ConditionId, "i=9111", [
        { dataType: ua.DataType.ByteString, value: eventId },
        { dataType: ua.DataType.LocalizedText, value: { text: "seen" } },
    ]);
    const statuses = [];
    statuses.push((await acknowledge(viewer, raised.EventId)).status);
    statuses.push((await acknowledge(s, Buffer.from("nonsense"))).status);
    statuses.push((await acknowledge(s, raised.EventId)).status);
    const acked = await until(() => watching.events.find((one) => one["AckedState.Id"]));
    statuses.push((await acknowledge(s, acked.EventId)).status);
    const conditions = watching.events.filter((one) => one.ConditionName).length;
    await call(s, "i=2782", "i=3875", [{ dataType: ua.DataType.UInt32, value: watching.subscription.subscriptionId }]);
    const refreshed = await until(() => watching.events.filter((one) => one.ConditionName).length > conditions);
    await ask("alarm - -");
    const gone = await until(() => watching.events.find((one) => one.ConditionName && one["ActiveState.Id"] === false));
    await sleep(200);
    await watching.subscription.terminate();
    return {
        raised: plain(raised), acked: plain(acked), gone: plain(gone), statuses, refreshed: !!refreshed, inError,
        after: await m.state(), events: watching.events.map(plain),
    };
}

async function handshake(s, viewer, root) {
    const node = await find(s, root, `/${config.index}:Handshake`);
    const claim = await find(s, node, `/${config.index}:claim`);
    const lift = (value) => [{ dataType: ua.DataType.String, value }];
    const told = (answer) => [answer.status, answer.outputs.map((one) => one.value)];
    const wrong = [{ dataType: ua.DataType.Double, value: 3 }];
    return {
        taken: told(await call(s, node, claim, lift("lift-1"))), unknown: told(await call(s, node, claim, lift("x"))),
        viewer: told(await call(viewer, node, claim, lift("lift-1"))), wrong: told(await call(s, node, claim, wrong)),
        none: told(await call(s, node, claim, [])),
    };
}

async function state(s, root) {
    const values = {};
    async function walk(node, path) {
        for (const child of await names(s, node, "HierarchicalReferences")) {
            const here = path ? `${path}.${child.browseName.name}` : child.browseName.name;
            if (child.nodeClass === ua.NodeClass.Variable) {
                const read = await s.read({ nodeId: child.nodeId, attributeId: 13 });
                const value = read.value.value;
                values[here] = [read.statusCode.name, ArrayBuffer.isView(value) ? Array.from(value) : value];
            } else await walk(child.nodeId, here);
        }
    }
    await walk(await find(s, root, `/${config.index}:State`), "");
    return values;
}

async function latencies(m, root) {
    const node = await find(m.s, root, `/${config.index}:State.${config.index}:life_counter`);
    const times = { read: [], call: [] };
    for (let i = 0; i < config.calls; i++) {
        for (const [key, one] of [["read", () => m.s.read({ nodeId: node, attributeId: 13 })], ["call", () => m.do("Stop")]]) {
            const start = process.hrtime.bigint();
            await one();
            times[key].push(Number(process.hrtime.bigint() - start) / 1e6);
        }
    }
    return times;
}

async function full() {
    const engineer = await session(config.trusted, ["engineer", config.password]);
    const anonymous = await session(config.trusted, null);
    const s = engineer.session;
    const namespaces = await s.readNamespaceArray();
    config.index = namespaces.indexOf("urn:barsight:crane");
    const ns = namespaces.indexOf("http://opcfoundation.org/UA/MachineVision");
    const root = await find(s, "ObjectsFolder", `/${config.index}:Barsight`);
    const report = { namespaces, state: await state(s, root) };
    report.handshake = await handshake(s, anonymous.session, root);
    const write = await s.write({
        nodeId: await find(s, root, `/${config.index}:State.${config.index}:mode`), attributeId: 13,
        value: { value: { dataType: ua.DataType.String, value: "mine" } },
    });
    report.write = write.name;
    const m = new Machine(s, ns);
    await m.learn();
    report.table = await table(s, ns);
    report.transitions = await transitions(m);
    report.viewer = {};
    for (const name of Object.keys(m.methods)) report.viewer[name] = (await m.do(name, anonymous.session)).status;
    report.job = await job(m, s);
    report.alarm = await alarm(m, s, anonymous.session);
    if (config.calls) report.latencies = await latencies(m, root);
    await ask("quiet");
    await sleep(400);
    report.quiet = await state(s, root);
    await engineer.client.disconnect();
    await anonymous.client.disconnect();
    return report;
}

async function strangers() {
    return {
        untrusted: await refused(config.stranger, null), expired: await refused(config.expired, null),
        unsecured: await refused(config.trusted, null, false),
        password: await refused(config.trusted, ["engineer", "wrong password"]),
        unknown: await refused(config.trusted, ["nobody", "wrong password"]),
    };
}

async function main() {
    manager = new OPCUACertificateManager({ automaticallyAcceptUnknownCertificate: true, rootFolder: config.pki });
    await manager.initialize();
    const report = { strangers: await strangers(), ...(await full()) };
    fs.writeFileSync(config.report, JSON.stringify(report, (key, value) => typeof value === "bigint" ? Number(value) : value));
    process.exit(0);
}
main().catch((error) => { console.error(error); process.exit(1); });
