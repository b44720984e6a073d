//! Compares what clients were told with the real motions.

use ztl_core::{State, TaskId};
use ztl_link::LinkEvent;

use super::client::Known;
use super::motor::Truth;
use super::summary::Summary;

/// What clients know about each task.
pub(super) struct Books {
    pub(super) journal: bool,
    pub(super) tasks: Vec<Book>,
    /// The final states that gateways reported, by task id.
    pub(super) decided: Vec<(TaskId, State, String)>,
    /// The events that devices have reported.
    pub(super) reported: Vec<String>,
    /// Whether a gateway was killed. Otherwise every client can learn the outcome of its INIT.
    pub(super) killed: bool,
}

pub(super) struct Book {
    client: usize,
    /// Of which motor, by device.
    pub(super) motor: (usize, usize),
    known: Known,
    /// The id that it had.
    pub(super) id: Option<TaskId>,
    /// Whether the device has started it.
    pub(super) own: bool,
}

impl Books {
    pub(super) fn new(journal: bool) -> Self {
        Self {
            journal,
            tasks: Vec::new(),
            decided: Vec::new(),
            reported: Vec::new(),
            killed: false,
        }
    }

    pub(super) fn ask(&mut self, client: usize, motor: (usize, usize)) -> usize {
        self.tasks.push(Book {
            client,
            motor,
            known: Known::Asked,
            id: None,
            own: false,
        });
        self.tasks.len() - 1
    }

    /// A device starts a task itself. A client that aborts it later knows of it.
    pub(super) fn press(&mut self, motor: (usize, usize)) -> usize {
        let task = self.ask(0, motor);
        self.tasks[task].own = true;
        task
    }

    pub(super) fn id(&self, task: usize) -> Option<TaskId> {
        self.tasks.get(task).and_then(|book| book.id)
    }

    pub(super) fn all(&self) -> Vec<(usize, usize, Known)> {
        let tasks = self.tasks.iter().enumerate();
        tasks
            .map(|(task, book)| (task, book.client, book.known.clone()))
            .collect()
    }

    /// The gateway is dead: without a journal it has forgotten all.
    pub(super) fn killed(&mut self) {
        self.killed = true;
        if !self.journal {
            self.decided.clear();
        }
    }

    /// Checks an event of a session.
    pub(super) fn on_event(&mut self, event: &LinkEvent, truth: &Truth) -> Result<(), String> {
        let (id, state, text) = match event {
            LinkEvent::TaskRejected(id, text) => (*id, State::Rejected, text),
            LinkEvent::Ended(id, state, text) => (*id, *state, text),
            _ => return Ok(()),
        };
        if let Some((_, before, why)) = self.decided.iter().find(|(known, ..)| *known == id) {
            return Err(format!(
                "promise 2: {id} had ended as {before} ({why}), and ends as {state} ({text})"
            ));
        }
        self.decided.push((id, state, text.clone()));
        let task = self.tasks.iter().position(|book| book.id == Some(id));
        match task {
            Some(task) => judge_end(task, state, text, truth),
            None => Ok(()),
        }
    }

    /// Checks the latest knowledge of a client.
    pub(super) fn on_news(
        &mut self,
        task: usize,
        known: Known,
        truth: &Truth,
    ) -> Result<(), String> {
        let journal = self.journal;
        let book = &mut self.tasks[task];
        let before = &book.known;
        let wrong = |promise: u8, what: &str| {
            Err(format!(
                "promise {promise}: the client of task {task}, who knew {before:?}, hears {known:?}{what}"
            ))
        };
        match (before, &known) {
            (Known::Ended(id, state, text), Known::Ended(other, again, now)) => {
                if (id, state) != (other, again) || (text != now && !journal) {
                    return wrong(2, "");
                }
                return Ok(());
            }
            (Known::Asked, _) | (Known::Open(_), Known::Ended(..)) => {}
            (_, Known::Forgotten(_)) if !journal => {}
            _ => return wrong(2, ""),
        }
        match &known {
            Known::Never(_) => {
                let begun = truth
                    .tasks
                    .get(task)
                    .is_some_and(|execution| execution.begun > 0);
                if begun {
                    return wrong(6, ", but it was begun");
                }
            }
            Known::Ended(_, state, text) => judge_end(task, *state, text, truth)?,
            Known::Unknown if !self.killed => return wrong(2, ", though its server lives"),
            _ => {}
        }
        book.id = known.id().or(book.id);
        // Its final state never changes.
        if !matches!(book.known, Known::Ended(..)) {
            book.known = known;
        }
        Ok(())
    }

    /// What must be true at any time.
    pub(super) fn judge(&self, truth: &Truth) -> Result<(), String> {
        if let Some(task) = truth.tasks.iter().position(|execution| execution.begun > 1) {
            return Err(format!("promise 1: task {task} is begun twice"));
        }
        for (task, _) in truth.moving() {
            let Some(book) = self.tasks.get(task) else {
                continue;
            };
            let end = match &book.known {
                Known::Never(why) => (6, why),
                Known::Ended(_, State::Rejected, why) => (6, why),
                Known::Ended(.., why) => (4, why),
                _ => continue,
            };
            let (promise, why) = end;
            if !truth.moves_after(task, why) {
                continue;
            }
            return Err(format!(
                "promise {promise}: task {task} moves, and its client was told: {why}"
            ));
        }
        Ok(())
    }

    /// Promise 4: of a device that has not been heard for so long, the tasks of motors that act by
    /// themselves have ended.
    pub(super) fn judge_silent(&self, device: usize, acts: [bool; 2]) -> Result<(), String> {
        if self.killed && !self.journal {
            // The restart does not inform clients that their tasks are lost.
            return Ok(());
        }
        for (task, book) in self.tasks.iter().enumerate() {
            let its = book.motor.0 == device && acts.get(book.motor.1) == Some(&true);
            let (true, Known::Open(id)) = (its, &book.known) else {
                continue;
            };
            if !self.decided.iter().any(|(ended, ..)| ended == id) {
                return Err(format!(
                    "promise 4: task {task} has no end, and device {device} is not heard"
                ));
            }
        }
        Ok(())
    }

    /// Checks that every task has ended, after a long time without faults.
    pub(super) fn settled(&self, truth: &Truth) -> Result<(), String> {
        for (task, book) in self.tasks.iter().enumerate() {
            let execution = truth.tasks.get(task).copied().unwrap_or_default();
            match &book.known {
                Known::Asked if book.own => {}
                Known::Asked => return Err(format!("task {task}: its INIT is never answered")),
                Known::Open(_) => return Err(format!("promise 2: task {task} never ends")),
                Known::Never(why) if execution.begun > 0 => {
                    return Err(format!(
                        "promise 6: task {task} was refused ({why}) and begun"
                    ));
                }
                _ => {}
            }
            if truth.moves(task) {
                return Err(format!("promise 4: task {task} moves for ever"));
            }
        }
        Ok(())
    }

    /// Promise 3: the device serves after all faults.
    pub(super) fn came_to(&self, task: usize, expected: State) -> Result<(), String> {
        match &self.tasks[task].known {
            Known::Ended(_, state, _) if *state == expected => Ok(()),
            known => Err(format!("promise 3: a new task, {task}, comes to {known:?}")),
        }
    }

    pub(super) fn summary(&self, truth: &Truth) -> Summary {
        let mut summary = Summary {
            begun: truth.tasks.iter().map(|execution| execution.begun).sum(),
            ..Summary::default()
        };
        for book in &self.tasks {
            match &book.known {
                Known::Ended(_, State::Completed, _) => summary.completed += 1,
                Known::Ended(_, State::Rejected, _) | Known::Never(_) => summary.refused += 1,
                Known::Ended(..) => summary.ended += 1,
                _ => summary.unknown += 1,
            }
        }
        summary
    }
}

/// Checks a reported final state against the truth.
fn judge_end(task: usize, state: State, text: &str, truth: &Truth) -> Result<(), String> {
    let execution = truth.tasks.get(task).copied().unwrap_or_default();
    let lie = |promise: u8, why: &str| {
        Err(format!(
            "promise {promise}: task {task} is told {state} ({text}), {why}"
        ))
    };
    if truth.moves_after(task, text) {
        return lie(4, "and moves");
    }
    match state {
        State::Rejected if execution.begun > 0 => lie(6, "and was begun"),
        State::Completed if execution.came_to != Some(State::Completed) => {
            lie(2, "and did not come to its goal")
        }
        State::Aborted if execution.begun > 0 && execution.came_to != Some(State::Aborted) => {
            lie(2, "and was not stopped")
        }
        _ => Ok(()),
    }
}
