// Reads an MCAP file with Foxglove's reader, CRCs checked -> JSON: messages by topic, read and as the summary says.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";

const file = await open(process.argv[2]);
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: await loadDecompressHandlers(),
});
const read = {};
let last = 0n;
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const { topic } = reader.channelsById.get(message.channelId);
  read[topic] = (read[topic] ?? 0) + 1;
  if (message.logTime < last) throw new Error(`${topic} goes back in time at ${message.logTime} ns`);
  last = message.logTime;
}
const summary = {};
for (const [id, count] of reader.statistics.channelMessageCounts) {
  summary[reader.channelsById.get(id).topic] = Number(count);
}
console.log(JSON.stringify({ read, summary }));
