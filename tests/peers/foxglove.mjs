// Reads a recording as Foxglove does: with the indexed reader of @mcap/core. Checks its schemas and messages against
// Foxglove's own, and prints a line of JSON for each message.
//
// node foxglove.mjs FILE.mcap

import assert from 'node:assert/strict'
import { open } from 'node:fs/promises'
import { createRequire } from 'node:module'
import { join } from 'node:path'
import { argv, env } from 'node:process'

const require = createRequire(join(env.ZTL_CLIENTS, 'node_modules', 'here.js'))
const { McapIndexedReader } = require('@mcap/core')
const known = require('@foxglove/schemas/jsonschema')
const Ajv = require('ajv/dist/2020').default

const file = await open(argv[2])
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, size) => {
    const bytes = new Uint8Array(Number(size))
    const { bytesRead } = await file.read(bytes, 0, bytes.length, Number(offset))
    assert.equal(bytesRead, bytes.length)
    return bytes
  }
}
const reader = await McapIndexedReader.Initialize({ readable })
const ajv = new Ajv({ strict: false, allErrors: true })
const checks = new Map()
for (const { id, name, encoding, data } of reader.schemasById.values()) {
  assert.equal(encoding, 'jsonschema')
  const own = JSON.parse(new TextDecoder().decode(data))
  assert.equal(own.type, 'object')
  const wellKnown = name.startsWith('foxglove.') ? known[name.split('.')[1]] : own
  // Foxglove finds its schemas by name, and decodes bytes by the schema in the file.
  const shape = ({ properties, required }) => ({
    required,
    properties: Object.entries(properties).map(([key, { type, contentEncoding, title }]) =>
      JSON.stringify([key, type, contentEncoding, title])).sort()
  })
  assert.deepEqual(shape(own), shape(wellKnown))
  checks.set(id, [ajv.compile(own), ajv.compile(wellKnown)])
}

let count = 0
let last = 0n
const show = (message) => {
  const { topic, schemaId, messageEncoding, metadata } = reader.channelsById.get(message.channelId)
  const schema = reader.schemasById.get(schemaId)?.name ?? null
  let value = Buffer.from(message.data).toString('hex')
  if (messageEncoding === 'json') {
    value = JSON.parse(new TextDecoder().decode(message.data))
    for (const check of checks.get(schemaId)) {
      assert(check(value), `${topic}: ${JSON.stringify(check.errors)}`)
    }
  }
  return {
    topic, schema, publisher: metadata.get('publisher'), value,
    log: String(message.logTime), publish: String(message.publishTime)
  }
}
for await (const message of reader.readMessages()) {
  assert(message.logTime >= last, 'in order')
  last = message.logTime
  count += 1
  console.log(JSON.stringify(show(message)))
}
const { messageCount, messageStartTime, messageEndTime, channelMessageCounts } = reader.statistics
assert.equal(messageCount, BigInt(count))
assert.equal(messageEndTime, last)
// By topic and by time, as panels ask.
for (const { id, topic } of reader.channelsById.values()) {
  let found = 0
  for await (const message of reader.readMessages({ topics: [topic] })) {
    found += message.channelId === id ? 1 : 0
  }
  assert.equal(channelMessageCounts.get(id), BigInt(found), topic)
}
let before = 0
for await (const _ of reader.readMessages({ startTime: messageStartTime, endTime: last - 1n })) {
  before += 1
}
assert(before < count && before > 0)
await file.close()
