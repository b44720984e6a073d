//! What a server's components say of themselves: its answers to `describe`.

use std::collections::BTreeMap;

use serde_json::Value;

use super::error::RequestError;
use super::remote_task::RemoteTask;
use crate::describe::{ComponentDescription, ScopeDescriptions, component};

/// What is read from a server at most.
#[derive(Debug)]
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
        self.ask_described("", OF_SERVER)
    }

    /// The same about the scope of this client alone, and at most 1,000 components, 1 MiB and 32 answers.
    ///
    /// # Errors
    /// [`RequestError`].
    pub fn describe_scope(&mut self) -> Result<ScopeDescriptions, RequestError> {
        let scope = self.scope().to_owned();
        let all = self.ask_described(&scope, OF_SCOPE)?;
        Ok(of_scope(all, &scope))
    }

    fn ask_described(
        &mut self,
        scope: &str,
        most: Most,
    ) -> Result<Vec<DescribedComponent>, RequestError> {
        let mut asked = DescribeQuestions::new(scope, most);
        loop {
            let answer = self.ask_server(&asked.question())?;
            if !answer.is_some_and(|answer| asked.on_answer(&answer)) {
                return Ok(asked.all);
            }
        }
    }
}

/// The questions that it takes to read what all components of a server say of themselves, one after the other: for
/// [`ParallelRequests`](super::ParallelRequests).
#[derive(Debug)]
pub struct DescribeQuestions {
    scope: String,
    most: Most,
    from: usize,
    bytes: usize,
    answers: usize,
    all: Vec<DescribedComponent>,
}

impl DescribeQuestions {
    /// Questions about all scopes of a server: at most 10,000 components, 16 MiB and 256 answers.
    #[must_use]
    pub fn of_server() -> Self {
        Self::new("", OF_SERVER)
    }

    fn new(scope: &str, most: Most) -> Self {
        Self {
            scope: scope.to_owned(),
            most,
            from: 0,
            bytes: 0,
            answers: 0,
            all: Vec::new(),
        }
    }

    /// The next question.
    #[must_use]
    pub fn question(&self) -> String {
        format!("describe {};{}", self.scope, self.from)
    }

    /// Reads an answer, and skips what is unreadable. Returns whether there is another question.
    pub fn on_answer(&mut self, answer: &str) -> bool {
        self.bytes += answer.len();
        self.answers += 1;
        let next = read(answer, &mut self.all);
        let fits = self.all.len() < self.most.components
            && self.bytes < self.most.bytes
            && self.answers < self.most.answers;
        let next = next.filter(|next| *next > self.from && fits);
        self.from = next.unwrap_or(self.from);
        self.all.truncate(self.most.components);
        next.is_some()
    }

    /// What was read, by scope.
    #[must_use]
    pub fn into_scopes(self) -> BTreeMap<String, ScopeDescriptions> {
        by_scope(self.all)
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
    by_scope(all).remove(scope).unwrap_or_default()
}

/// The components by scope, handler and name.
fn by_scope(all: Vec<DescribedComponent>) -> BTreeMap<String, ScopeDescriptions> {
    let mut scopes = BTreeMap::<_, ScopeDescriptions>::new();
    for it in all {
        let handlers = scopes.entry(it.scope).or_default();
        let components = handlers.entry(it.handler).or_default();
        components.insert(it.component, it.is);
    }
    scopes
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
