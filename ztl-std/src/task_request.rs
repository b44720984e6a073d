//! A task's payload, decoded and encoded.

use ztl_core::{TaskId, TaskSpec};

/// What a client asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskRequest {
    /// The id that the client is given.
    pub id: TaskId,
    /// Who is to do it, such as `cob`.
    pub handler: String,
    /// The part to use, such as `head`.
    pub component: String,
    /// What to achieve, such as `left`.
    pub goal: String,
}

impl TaskRequest {
    /// Decodes the payload of an INIT.
    ///
    /// # Errors
    /// The text that the original reports for such a payload.
    pub(crate) fn decode(id: TaskId, payload: &str) -> Result<Self, String> {
        let mut buffer = vec![0; payload.len()];
        match TaskSpec::decode(payload, &mut buffer) {
            Ok(spec) => Ok(Self {
                id,
                handler: spec.handler.to_owned(),
                component: spec.component.to_owned(),
                goal: spec.goal.to_owned(),
            }),
            Err(error) => Err(error.to_string()),
        }
    }

    /// The specification as clients write it.
    #[must_use]
    pub fn spec(&self) -> TaskSpec<'_> {
        TaskSpec {
            handler: &self.handler,
            component: &self.component,
            goal: &self.goal,
        }
    }

    /// The text that answers the INIT of an accepted task.
    #[must_use]
    pub fn reply(&self) -> String {
        let length = self.handler.len() + self.component.len() + self.goal.len();
        // Enough unless something has to be escaped.
        let mut reply = Vec::with_capacity(96 + length);
        self.spec().put_initiated(self.id, &mut |bytes: &[u8]| {
            reply.extend_from_slice(bytes);
        });
        into_text(reply)
    }
}

/// The payload of an INIT: the specification in base64.
#[must_use]
pub fn encoded(handler: &str, component: &str, goal: &str) -> String {
    let spec = TaskSpec {
        handler,
        component,
        goal,
    };
    let mut payload = Vec::with_capacity(spec.encoded_len());
    spec.put(&mut |bytes: &[u8]| payload.extend_from_slice(bytes));
    into_text(payload)
}

fn into_text(bytes: Vec<u8>) -> String {
    String::from_utf8(bytes)
        .unwrap_or_else(|error| String::from_utf8_lossy(error.as_bytes()).into_owned())
}
