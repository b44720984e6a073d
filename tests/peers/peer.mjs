// zeromq.js as a client and as a server: see README.md. ZTL_CLIENTS is the directory with its node_modules.

import { createRequire } from "node:module"
import { createInterface } from "node:readline"
import { setTimeout as sleep } from "node:timers/promises"

const { Publisher, Reply, Request, Subscriber } = createRequire(`${process.env.ZTL_CLIENTS}/`)("zeromq")

const ACCEPTED = 1, REJECTED = 2, FAILED = 3, COMPLETED = 5
const hex = (text) => Buffer.from(text).toString("hex")
const unhex = (text) => Buffer.from(text, "hex").toString()

/** `scope;state;id;payload`, where the payload may have semicolons. */
function parts(message) {
  const [scope, state, id, ...payload] = message.toString().split(";")
  return { scope, state: Number(state), id: Number(id), payload: payload.join(";") }
}

async function client(host, port, scope) {
  const server = new Request({ linger: 0, sendTimeout: 60000, receiveTimeout: 60000 })
  server.connect(`tcp://${host}:${port}`)
  console.error(`Remote task interface initialised at 'tcp://${host}:${port}'.`)

  async function ask(code, id, payload) {
    await server.send(`${scope};${code};${id};${payload}`)
    const [answer] = await server.receive()
    return parts(answer)
  }
  async function wait(id, seconds) {
    const end = Date.now() + seconds * 1000
    for (;;) {
      const answer = await ask(2, id, "waiting poll")
      if (answer.state > ACCEPTED || (seconds > 0 && Date.now() > end)) return answer
      await sleep(100)
    }
  }
  for await (const line of createInterface({ input: process.stdin })) {
    const [verb, ...words] = line.split(" ")
    let number, text
    if (verb === "trigger") {
      const task = Buffer.from(words.map(unhex).join(":")).toString("base64")
      ;({ id: number, payload: text } = await ask(1, -1, task))
    } else if (verb === "status") {
      ;({ state: number, payload: text } = await ask(2, words[0], "status update"))
    } else if (verb === "abort") {
      ;({ state: number, payload: text } = await ask(3, words[0], "abort command"))
    } else {
      ;({ state: number, payload: text } = await wait(words[0], Number(words[1])))
    }
    console.log(`${number} ${hex(text)}`)
  }
}

async function server(port, ownScope) {
  const socket = new Reply()
  await socket.bind(`tcp://*:${port}`)
  console.log(`Registering controller for scope '${ownScope}'.`)
  const tasks = new Map()

  function answer({ scope, state, id, payload }) {
    if (scope !== ownScope) return [REJECTED, -1, `No controller for scope: ${scope}`]
    if (state === 1) {
      const [handler, component, ...goal] = Buffer.from(payload, "base64").toString().split(":")
      const text = goal.join(":")
      if (handler !== "test") return [REJECTED, -1, `No such handler '${handler}', try 'test'.`]
      const ends = Date.now() + (component === "sleep" ? Number(text) * 1000 : 0)
      tasks.set(tasks.size + 1, { ends, component, text })
      return [ACCEPTED, tasks.size, "Initiated"]
    }
    const task = tasks.get(id)
    if (task === undefined) return [REJECTED, id, `Invalid ID '${id}'`]
    if (Date.now() < task.ends) return [ACCEPTED, id, state === 3 ? "False" : "None"]
    if (task.component === "echo") return [COMPLETED, id, task.text]
    return task.component === "sleep" ? [COMPLETED, id, "True"] : [FAILED, id, "No such component"]
  }
  for await (const [message] of socket) {
    const request = parts(message)
    await socket.send([request.scope, ...answer(request)].join(";"))
  }
}

async function publisher(port) {
  const socket = new Publisher()
  await socket.bind(`tcp://*:${port}`)
  console.log("ready")
  for await (const line of createInterface({ input: process.stdin })) {
    await socket.send(line.split(" ").map((word) => Buffer.from(word, "hex")))
  }
}

async function subscriber(port, topic) {
  const socket = new Subscriber()
  socket.connect(`tcp://127.0.0.1:${port}`)
  socket.subscribe(topic)
  for await (const frames of socket) {
    console.log(frames.map((frame) => frame.toString("hex")).join(" "))
  }
}

const [role, ...words] = process.argv.slice(2)
if (role === "client") await client(...words)
else if (role === "server") await server(words[1], words[3])
else await (role === "publisher" ? publisher : subscriber)(...words)
