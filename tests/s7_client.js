// A client of nodes7 that reads and writes data blocks, as JSON: node s7_client.js PORT ADDRESS... [ADDRESS=VALUE]
"use strict";
const { S7Endpoint, S7ItemGroup } = require("@st-one-io/nodes7");
const [port, ...words] = process.argv.slice(2);
async function main() {
    const plc = new S7Endpoint({ host: "127.0.0.1", port: Number(port), rack: 0, slot: 1, autoReconnect: 0 });
    plc.on("error", (error) => { console.error(error); process.exit(1); });
    await plc.connect();
    const group = new S7ItemGroup(plc);
    const reads = words.filter((one) => !one.includes("="));
    for (const one of words.filter((one) => one.includes("="))) {
        const [address, value] = one.split("=");
        const writing = new S7ItemGroup(plc);
        writing.addItems([address]);
        await writing.writeItems([address], [JSON.parse(value)]);
    }
    group.addItems(reads);
    console.log(JSON.stringify(await group.readAllItems()));
    await plc.disconnect();
    process.exit(0);
}
main().catch((error) => { console.error(error); process.exit(1); });
