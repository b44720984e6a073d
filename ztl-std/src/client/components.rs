//! What a server's components say of themselves: its answers to `describe`.

use serde_json::Value;

use super::error::RequestError;
use super::remote_task::RemoteTask;
use crate::describe::{ComponentDescription, component};

/// Most components that are read from one server.
const MOST: usize = 10_000;
/// Most bytes that are read from one server.
const MOST_BYTES: usize = 16 << 20;
/// Most answers that are read from one server.
const MOST_PARTS: usize = 256;

/// A component and what it says of itself.
#[derive(Debug, Clone)]
pub struct DescribedComponent {
    /// Its scope.
    pub scope: String,
    /// Its handler; `*` stands for every other one.
    pub handler: String,
    /// Its name; `*` stands for every other one.
    pub component: String,
    /// What it says.
    pub is: ComponentDescription,
}

impl RemoteTask {
    /// Asks the server what its components say of themselves: nothing, if it is an older one or one of the
    /// original's. Skips what is unreadable. Reads at most 10,000 components, 16 MiB and 256
    /// answers.
    ///
    /// # Errors
    /// [`RequestError`].
    pub fn describe_components(&mut self) -> Result<Vec<DescribedComponent>, RequestError> {
        let mut all = Vec::new();
        let (mut from, mut bytes) = (0, 0);
        for _ in 0..MOST_PARTS {
            let Some(answer) = self.ask_server(&format!("describe ;{from}"))? else {
                return Ok(all);
            };
            bytes += answer.len();
            let next = read(&answer, &mut all);
            match next {
                Some(next) if next > from && all.len() < MOST && bytes < MOST_BYTES => from = next,
                _ => break,
            }
        }
        all.truncate(MOST);
        Ok(all)
    }
}

/// Reads one answer. Returns the number of the component with which the next begins.
fn read(answer: &str, all: &mut Vec<DescribedComponent>) -> Option<usize> {
    let answer: Value = serde_json::from_str(answer).ok()?;
    let components = answer.get("components").and_then(Value::as_array);
    all.extend(
        components
            .into_iter()
            .flatten()
            .filter_map(DescribedComponent::read),
    );
    usize::try_from(answer.get("next")?.as_u64()?).ok()
}

impl DescribedComponent {
    /// Reads a component with its names, as in an answer to `describe`; `None` if it is unreadable.
    #[must_use]
    pub fn read(entry: &Value) -> Option<Self> {
        let text = |key| entry.get(key).and_then(Value::as_str).map(str::to_owned);
        Some(Self {
            scope: text("scope")?,
            handler: text("handler")?,
            component: text("component")?,
            is: component(entry.get("is")?)?,
        })
    }
}
