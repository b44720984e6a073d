//! The messages of rosbridge's protocol 2.1: what clients send and receive.

use serde::Deserialize;
use serde_json::{Value, json};
use ztl_std::State;

use crate::outcome::{GoalState, Outcome};

/// A client's message. Members that others of its kind have are ignored.
#[derive(Debug, Deserialize)]
#[serde(tag = "op", rename_all = "snake_case")]
pub(crate) enum Incoming {
    SendActionGoal {
        #[serde(default)]
        id: String,
        action: String,
        #[serde(default)]
        args: GoalArgs,
        #[serde(default)]
        feedback: bool,
    },
    CancelActionGoal {
        #[serde(default)]
        id: String,
        #[serde(default)]
        action: String,
    },
    CallService {
        id: Option<Value>,
        service: String,
        #[serde(default)]
        args: Value,
    },
    Subscribe {
        topic: String,
    },
    Unsubscribe {
        topic: String,
    },
}

impl Incoming {
    /// The length of its longest id or name, in bytes: an answer repeats them.
    pub(crate) fn longest_name(&self) -> usize {
        match self {
            Self::SendActionGoal { id, action, .. } | Self::CancelActionGoal { id, action } => {
                id.len().max(action.len())
            }
            Self::CallService { id, service, .. } => {
                let id = id.as_ref().map_or(0, |id| id.to_string().len());
                id.max(service.len())
            }
            Self::Subscribe { topic } | Self::Unsubscribe { topic } => topic.len(),
        }
    }
}

/// What a message is about, read without its arguments, which takes little time also for hostile ones.
#[derive(Debug, Deserialize)]
pub(crate) struct Head {
    op: String,
    id: Option<String>,
    action: Option<String>,
}

impl Head {
    /// The id and action of a goal.
    pub(crate) fn goal(self) -> Option<(String, String)> {
        let is_goal = self.op == "send_action_goal";
        is_goal.then(|| (self.id.unwrap_or_default(), self.action.unwrap_or_default()))
    }
}

/// The goal of an action.
#[derive(Debug, Default, Deserialize)]
pub(crate) struct GoalArgs {
    #[serde(default)]
    pub(crate) goal: String,
    /// Until when it may be sent, by the console's clock.
    #[serde(default)]
    pub(crate) not_after_ms: Option<f64>,
}

/// GoalStatus of action_msgs.
fn goal_status(state: GoalState) -> i64 {
    match state {
        GoalState::Task(State::Completed) => 4,
        GoalState::Task(State::Aborted) => 5,
        GoalState::Unknown => 0,
        _ => 6,
    }
}

/// The result of a goal that was sent to its robot, or may have been.
pub(crate) fn action_result(id: &str, action: &str, outcome: &Outcome) -> String {
    json!({
        "op": "action_result", "id": id, "action": action, "values": outcome,
        "status": goal_status(outcome.state), "result": true,
    })
    .to_string()
}

/// The result of a goal that was not sent.
pub(crate) fn goal_refused(id: &str, action: &str, why: &str) -> String {
    json!({
        "op": "action_result", "id": id, "action": action, "values": why, "status": 6, "result": false,
    })
    .to_string()
}

pub(crate) fn action_feedback(id: &str, action: &str, progress: &str) -> String {
    json!({
        "op": "action_feedback", "id": id, "action": action, "values": { "progress": progress },
    })
    .to_string()
}

/// The answer to a service call.
pub(crate) fn service_response(
    id: Option<&Value>,
    service: &str,
    told: Result<Value, String>,
) -> String {
    let mut message =
        json!({ "op": "service_response", "service": service, "result": told.is_ok() });
    if let Some(members) = message.as_object_mut() {
        if let Some(id) = id {
            members.insert("id".to_owned(), id.clone());
        }
        members.insert("values".to_owned(), told.unwrap_or_else(Value::String));
    }
    message.to_string()
}

/// The newest value of a topic, which is JSON.
pub(crate) fn publish(topic: &str, value: &str) -> String {
    format!(
        "{{\"op\":\"publish\",\"topic\":{},\"msg\":{value}}}",
        json!(topic)
    )
}

/// What is wrong with a client's message.
pub(crate) fn error(text: &str) -> String {
    json!({ "op": "status", "level": "error", "msg": text }).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_read_without_their_optional_members() {
        let read = |text| serde_json::from_str::<Incoming>(text);
        let goal = read(
            r#"{"op":"send_action_goal","action":"/r/a/b","action_type":"x","args":{"goal":"up"}}"#,
        );
        assert!(matches!(goal, Ok(Incoming::SendActionGoal { args, .. }) if args.goal == "up"));
        assert!(
            read(r#"{"op":"subscribe","topic":"/ztl/tasks","type":"any","throttle_rate":9}"#)
                .is_ok()
        );
        for wrong in [
            "",
            "[]",
            "{}",
            r#"{"op":7}"#,
            r#"{"op":"advertise"}"#,
            r#"{"op":"subscribe"}"#,
        ] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn an_unknown_outcome_has_the_status_unknown() {
        let id = ztl_std::RemoteId::from(7_i64);
        let outcome = Outcome {
            state: GoalState::Unknown,
            text: "no answer".to_owned(),
            id,
        };
        let told: Value =
            serde_json::from_str(&action_result("g", "/r/a/b", &outcome)).expect("JSON");
        assert_eq!(
            (&told["status"], &told["values"]["id"]),
            (&json!(0), &json!(7))
        );
        assert_eq!(
            [
                State::Completed,
                State::Aborted,
                State::Failed,
                State::Rejected
            ]
            .map(|state| goal_status(GoalState::Task(state))),
            [4, 5, 6, 6]
        );
    }
}
