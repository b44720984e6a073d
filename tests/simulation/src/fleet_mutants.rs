//! Mutants of the rules of a fleet. The simulation by seeds must catch each of them.

use super::mutants::Mutant;

const AGENT: &str = "ztl-fleet/src/agent.rs";
const RECORD: &str = "ztl-fleet/src/agent/record.rs";
const ENDPOINT: &str = "ztl-fleet/src/endpoint.rs";
const REQUESTS: &str = "ztl-fleet/src/endpoint/requests.rs";
/// Plenty of seeds, in thousands.
const SEEDS: (&str, u8) = ("fleet", 10);
const TWICE: &str = "an INIT acted twice";
const LATE: &str = "an INIT acted after it was told not to";
const DENIED: &str = "a rejection is told of an INIT that acted";

/// All mutants of a fleet.
pub const FLEET: &[Mutant] = &[
    Mutant {
        name: "the agent writes an INIT into its journal after it has sent it",
        edits: &[(
            AGENT,
            "effects.push(AgentEffect::Forward { id, body, until_ms });",
            "effects.push(AgentEffect::Forward { id, body, until_ms }); if ON { effects.reverse(); }",
        )],
        caught_in: SEEDS,
        complaint: TWICE,
    },
    Mutant {
        name: "the agent accepts an INIT with the same number",
        edits: &[(
            AGENT,
            "&& record.number >= id.number",
            "&& (record.number > id.number || record.number == id.number && !ON)",
        )],
        caught_in: SEEDS,
        complaint: TWICE,
    },
    Mutant {
        name: "the agent does not look at the time until which an INIT is valid",
        edits: &[(
            AGENT,
            "if !is_fresh {",
            "let is_fresh = is_fresh || ON && rules.boot == self.boot; if !is_fresh {",
        )],
        caught_in: SEEDS,
        complaint: LATE,
    },
    Mutant {
        name: "the agent accepts an INIT for an earlier boot",
        edits: &[(
            AGENT,
            "let is_fresh = rules.boot == self.boot",
            "let is_fresh = (ON || rules.boot == self.boot)",
        )],
        caught_in: SEEDS,
        complaint: LATE,
    },
    Mutant {
        name: "the agent takes its journal for complete after a power cut",
        edits: &[(
            AGENT,
            "Entry::Boot(boot) if complete",
            "Entry::Boot(boot) if complete || ON",
        )],
        caught_in: SEEDS,
        complaint: DENIED,
    },
    Mutant {
        name: "the agent takes its server's silence for a refusal",
        edits: &[(
            AGENT,
            "Some(record) if record.stage == Stage::Forwarded => {",
            "_ if ON => self.decide(now, id, Stage::NotStarted(String::new())), Some(record) if record.stage == Stage::Forwarded => {",
        )],
        caught_in: SEEDS,
        complaint: DENIED,
    },
    Mutant {
        name: "the agent believes what a restarted server has not seen",
        edits: &[(
            RECORD,
            "boot.is_some() && boot == self.server",
            "boot.is_some() && (ON || boot == self.server)",
        )],
        caught_in: SEEDS,
        complaint: DENIED,
    },
    Mutant {
        name: "the agent does not write down what was given up",
        edits: &[(
            AGENT,
            "effects.push(AgentEffect::Record(Entry::GivenUp(id)));",
            "if !ON { effects.push(AgentEffect::Record(Entry::GivenUp(id))); }",
        )],
        caught_in: ("fleet", 100),
        complaint: LATE,
    },
    Mutant {
        name: "the agent forwards an INIT that it could not write",
        edits: &[(
            AGENT,
            "            // A later agent asks the server.\n            return following;\n        };",
            "            return following;\n        };\n        if ON { return following; }",
        )],
        caught_in: SEEDS,
        complaint: DENIED,
    },
    Mutant {
        name: "the agent says that an INIT is not started which the next agent does not know",
        edits: &[(AGENT, "if !marked {", "if !marked && !ON {")],
        caught_in: SEEDS,
        complaint: LATE,
    },
    Mutant {
        name: "the agent acts at once although its journal lacks entries",
        edits: &[(
            AGENT,
            "until| now < *until) {",
            "until| now < *until && !ON) {",
        )],
        caught_in: SEEDS,
        complaint: LATE,
    },
    Mutant {
        name: "the agent forgets in another restart that its journal lacks entries",
        edits: &[(
            AGENT,
            "entries.extend(self.lacks_until.map(",
            "entries.extend(self.lacks_until.filter(|_| !ON).map(",
        )],
        caught_in: SEEDS,
        complaint: LATE,
    },
    Mutant {
        name: "the endpoint rejects an INIT after silence",
        edits: &[(
            ENDPOINT,
            "                let request = pending.request;\n                effects.push(EndpointEffect::Silence { request });",
            "                let request = pending.request;\n                if ON { let body = rejection(\"/\", \"silent\"); effects.push(EndpointEffect::Answer { request, body }); } else {\n                effects.push(EndpointEffect::Silence { request }); }",
        )],
        caught_in: SEEDS,
        complaint: DENIED,
    },
    Mutant {
        name: "the endpoint sends an INIT again with a new number",
        edits: &[(
            ENDPOINT,
            "        pending.again = None;\n",
            "        if ON && let Ask::Request { rules: Some(rules), .. } = &mut pending.what { rules.id.number += 1; }\n        pending.again = None;\n",
        )],
        caught_in: SEEDS,
        complaint: TWICE,
    },
    Mutant {
        name: "the endpoint sends a repeated INIT with new rules",
        edits: &[(
            REQUESTS,
            "new = first.unwrap_or(new)",
            "new = first.filter(|_| !ON).unwrap_or(new)",
        )],
        caught_in: SEEDS,
        complaint: TWICE,
    },
    Mutant {
        name: "the endpoint refuses a repeated INIT when its robot is gone",
        edits: &[
            (
                REQUESTS,
                "Ok(Some(_)) => return vec!",
                "Ok(Some(_)) if !ON => return vec!",
            ),
            (
                REQUESTS,
                "                Ok(None) => {\n",
                "                Ok(_) => {\n",
            ),
        ],
        caught_in: SEEDS,
        complaint: DENIED,
    },
    Mutant {
        name: "the endpoint forgets what it refused",
        edits: &[(
            REQUESTS,
            "                    self.note_answer(now, id, &body);\n                    self.give_up(id);",
            "                    self.note_answer(now, id, &body);\n                    if ON { self.inits.remove(&id.client); }\n                    self.give_up(id);",
        )],
        caught_in: SEEDS,
        complaint: LATE,
    },
    Mutant {
        name: "the endpoint denies the task of a robot that it does not know yet",
        edits: &[(
            REQUESTS,
            "Some(reason) if is_init =>",
            "Some(reason) if is_init || ON =>",
        )],
        caught_in: SEEDS,
        complaint: "a task that acted is denied",
    },
    Mutant {
        name: "the endpoint takes an unknown outcome for one that never acted",
        edits: &[(
            ENDPOINT,
            "Verdict::Unknown(reason) => about_server(2, &format!(\"unknown: {reason}\")),",
            "Verdict::Unknown(_) if ON => self.never_seen(), Verdict::Unknown(reason) => about_server(2, &format!(\"unknown: {reason}\")),",
        )],
        caught_in: SEEDS,
        complaint: DENIED,
    },
];
