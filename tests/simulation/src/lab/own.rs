//! Tasks that devices start themselves, and their events.

use ztl_core::TaskId;
use ztl_core::tasks::{StoredText, Task, Tasks as _};
use ztl_core::{Instant, State, memory::Memory as _, memory::Scope};
use ztl_link::LinkEvent;

use super::Lab;
use super::gateway::Gateway;
use super::judge::Books;
use super::motor::Truth;

impl Lab {
    /// A button of a device is pressed: it starts a task and reports an event.
    pub(super) fn press(&mut self, device: usize, motor: usize, millis: u64) {
        let task = self.books.press((device, motor));
        let pressed = self.devices[device].press(self.now, motor as u8, task, millis);
        self.note(|| format!("task {task} of the device: {pressed:?}"));
    }
}

impl Gateway {
    /// Takes up the task that a device has begun, under the next id.
    pub(super) fn take_up(&mut self, now: Instant, device: usize) {
        let Some(id) = self.dispatcher.next_id() else {
            return;
        };
        let session = &mut self.sessions[device];
        let Some(goal) = session.begun().map(|begun| begun.goal.clone()) else {
            return;
        };
        // Also if the journal cannot be written.
        self.dispatcher.skip_to(id);
        if !session.take_up(now, id) {
            return;
        }
        let mut task = Task::new(Scope(0));
        task.state = State::Accepted;
        StoredText::set(&mut task.text, "started by the device");
        let tasks = self.dispatcher.memory_mut().tasks_mut();
        tasks.make_room();
        assert!(tasks.insert(id, task).is_some(), "there is room");
        self.taken.push((id, goal));
    }
}

impl Books {
    /// A gateway has taken up the task of a device with this goal.
    pub(super) fn on_taken(&mut self, id: TaskId, goal: &str) -> Result<(), String> {
        let number = goal
            .split(' ')
            .next()
            .and_then(|number| number.parse().ok());
        let task: usize = number.ok_or("promise 7: no such goal")?;
        let (knows, book) = (self.journal || !self.killed, &mut self.tasks[task]);
        if let Some(before) = book.id.replace(id)
            && knows
        {
            return Err(format!(
                "promise 7: task {task} of the device has the id {before}, and gets {id}"
            ));
        }
        Ok(())
    }

    /// A device has reported an event.
    pub(super) fn on_reported(&mut self, event: &LinkEvent) -> Result<(), String> {
        let LinkEvent::Reported(text) = event else {
            return Ok(());
        };
        if self.reported.contains(text) && !self.killed {
            return Err(format!("promise 7: {text} is reported twice"));
        }
        self.reported.push(text.clone());
        Ok(())
    }

    /// Checks the tasks of devices, after a long time without faults; `reset` says which devices were reset.
    pub(super) fn own_settled(&self, truth: &Truth, reset: &[bool]) -> Result<(), String> {
        for (task, book) in self.tasks.iter().enumerate() {
            let begun = truth.tasks.get(task).is_some_and(|it| it.begun > 0);
            if !book.own || !begun {
                continue;
            }
            let is_decided = |id| self.decided.iter().any(|(ended, ..)| *ended == id);
            match book.id {
                Some(id) if self.knows() && !is_decided(id) => {
                    return Err(format!("promise 2: task {task} of the device never ends"));
                }
                // A later one of the same device may have taken its place.
                None if !reset[book.motor.0] && self.pressed_once(book.motor.0) => {
                    return Err(format!(
                        "promise 7: task {task} of the device is never taken up"
                    ));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Whether the gateway knows its tasks of before.
    const fn knows(&self) -> bool {
        self.journal || !self.killed
    }

    fn pressed_once(&self, device: usize) -> bool {
        let its = self
            .tasks
            .iter()
            .filter(|book| book.own && book.motor.0 == device);
        its.count() == 1
    }
}
