// A ZTL client in JavaScript, with no package but `zeromq`: starts a task and waits for its final
// state.
//
//     npm install zeromq@6
//     node client.mjs tcp://localhost:12345 /robot robot:base:forward
//
// prints the outcome, `COMPLETED: arrived`; the exit status is 0 only for COMPLETED.

import { setTimeout as sleep } from "node:timers/promises"
import { Request } from "zeromq"

const STATES = ["INITIATED", "ACCEPTED", "REJECTED", "FAILED", "ABORTED", "COMPLETED"]
const [endpoint, scope, task] = process.argv.slice(2)
const server = new Request({
  // Do not queue requests for an absent server; do not take a late reply for the next one.
  immediate: true, relaxed: true, correlate: true, linger: 0,
  sendTimeout: 2000, receiveTimeout: 2000,
})
server.connect(endpoint)

async function ask(code, about, payload) {
  await server.send(`${scope};${code};${about};${payload}`)
  const [answer] = await server.receive()
  const [, state, id, ...text] = answer.toString().split(";")
  return { state: Number(state), id: Number(id), text: text.join(";") }
}

let answer = await ask(1, -1, Buffer.from(task).toString("base64")).catch(() => {
  // Never resend: the first may have started the task.
  console.log("UNKNOWN: no answer, the task may run")
  process.exit(1)
})
const { id } = answer
while (answer.state <= 1) {
  await sleep(100)
  answer = await ask(2, id, "status update").catch(() => answer) // No reply is not a final state.
}
// A restarted server does not know the outcome.
const lost = answer.id > 0 && answer.text.startsWith("Invalid ID")
console.log(`${lost ? "UNKNOWN" : STATES[answer.state]}: ${answer.text}`)
process.exit(answer.state === 5 ? 0 : 1)
