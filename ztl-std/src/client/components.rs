//! What a server's components say of themselves: its answers to `describe`.

use serde_json::Value;

use super::error::RequestError;
use super::remote_task::RemoteTask;
use crate::describe::{ComponentDescription, ScopeDescriptions, component};

/// What is read from a server at most.
struct Most {
    components: usize,
    bytes: usize,
    answers: usize,
}

const OF_SERVER: Most = Most {
    components: 10_000,
    bytes: 16 << 20,
    answers: 256,
};

const OF_SCOPE: Most = Most {
    components: 1000,
    bytes: 1 << 20,
    answers: 32,
};

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
        self.ask_described("", &OF_SERVER)
    }

    /// The same about the scope of this client alone, and at most 1,000 components, 1 MiB and 32 answers.
    ///
    /// # Errors
    /// [`RequestError`].
    pub fn describe_scope(&mut self) -> Result<ScopeDescriptions, RequestError> {
        let scope = self.scope().to_owned();
        let all = self.ask_described(&scope, &OF_SCOPE)?;
        Ok(of_scope(all, &scope))
    }

    fn ask_described(
        &mut self,
        scope: &str,
        most: &Most,
    ) -> Result<Vec<DescribedComponent>, RequestError> {
        let mut all = Vec::new();
        let (mut from, mut bytes) = (0, 0);
        for _ in 0..most.answers {
            let Some(answer) = self.ask_server(&format!("describe {scope};{from}"))? else {
                return Ok(all);
            };
            bytes += answer.len();
            let next = read(&answer, &mut all);
            let fits = all.len() < most.components && bytes < most.bytes;
            match next {
                Some(next) if next > from && fits => from = next,
                _ => break,
            }
        }
        all.truncate(most.components);
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

/// The components of a scope by handler and name.
pub(super) fn of_scope(all: Vec<DescribedComponent>, scope: &str) -> ScopeDescriptions {
    let mut handlers = ScopeDescriptions::new();
    for it in all.into_iter().filter(|it| it.scope == scope) {
        let components = handlers.entry(it.handler).or_default();
        components.insert(it.component, it.is);
    }
    handlers
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
