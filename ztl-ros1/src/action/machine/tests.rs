use super::*;

const KEY: GoalKey = GoalKey(7);

/// A machine in virtual time.
struct Lab {
    machine: Machine,
    now: Instant,
    /// Effects that were not expected yet.
    effects: Vec<Effect>,
}

fn all(server: &str) -> Links {
    let nodes = vec![Arc::from(server)];
    Links {
        goal: nodes.clone(),
        cancel: nodes.clone(),
        status: nodes.clone(),
        feedback: nodes.clone(),
        result: nodes,
        unsettled: false,
    }
}

fn status(status: Status) -> GoalStatus<'static> {
    GoalStatus {
        id: "me-7".into(),
        status,
        text: "said".into(),
    }
}

fn goal_sent() -> Effect {
    Effect::SendGoal {
        id: "me-7".to_owned(),
        content: b"go".to_vec(),
    }
}

fn cancel_sent() -> Effect {
    Effect::SendCancel {
        id: "me-7".to_owned(),
    }
}

fn accepted() -> Effect {
    Effect::Event(KEY, GoalEvent::Accepted)
}

fn ended(state: EndState, text: &str, result: Option<&[u8]>) -> Effect {
    let end = GoalEnd {
        state,
        text: text.to_owned(),
        result: result.map(<[u8]>::to_vec),
    };
    Effect::Event(KEY, GoalEvent::Ended(end))
}

impl Lab {
    fn new() -> Self {
        Self {
            machine: Machine::new("me".to_owned()),
            now: Instant::now(),
            effects: Vec::new(),
        }
    }

    /// One that has sent its goal.
    fn sent() -> Self {
        let mut lab = Self::new();
        lab.links(all("/arm"));
        lab.pass(SETTLE);
        lab.send();
        lab.expect(&[goal_sent()]);
        lab
    }

    fn active() -> Self {
        let mut lab = Self::sent();
        lab.status("/arm", &[status(Status::Active)]);
        lab.expect(&[accepted()]);
        lab
    }

    fn send(&mut self) {
        let content = b"go".to_vec();
        self.machine.send(self.now, KEY, content, &mut self.effects);
    }

    fn cancel(&mut self) {
        self.machine.cancel(self.now, KEY, &mut self.effects);
    }

    fn links(&mut self, links: Links) {
        self.machine
            .handle_links(self.now, links, &mut self.effects);
    }

    fn status(&mut self, from: &str, statuses: &[GoalStatus<'_>]) {
        self.machine
            .handle_status(self.now, from, statuses, &mut self.effects);
    }

    fn feedback(&mut self, from: &str, content: &[u8]) {
        let active = status(Status::Active);
        self.machine
            .handle_feedback(self.now, from, &active, content, &mut self.effects);
    }

    fn result(&mut self, from: &str, is: Status) {
        let status = status(is);
        self.machine
            .handle_result(self.now, from, &status, b"42", &mut self.effects);
    }

    /// Lets the time pass, with every timeout in it.
    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        while let Some(next) = self.machine.poll_timeout().filter(|next| *next <= end) {
            self.now = self.now.max(next);
            self.machine.handle_timeout(self.now, &mut self.effects);
        }
        self.now = end;
        self.machine.handle_timeout(end, &mut self.effects);
    }

    #[track_caller]
    fn expect(&mut self, effects: &[Effect]) {
        assert_eq!(std::mem::take(&mut self.effects), effects);
    }

    #[track_caller]
    fn expect_end(&mut self, end: Effect) {
        self.expect(&[end]);
        assert!(self.machine.goals.is_empty());
    }
}

#[test]
fn a_goal_runs_from_its_server_to_its_result() {
    let mut lab = Lab::sent();
    lab.status("/arm", &[]);
    lab.status("/arm", &[status(Status::Pending)]);
    lab.expect(&[]);
    lab.status("/arm", &[status(Status::Active)]);
    lab.expect(&[accepted()]);
    lab.feedback("/arm", b"half");
    lab.expect(&[Effect::Event(KEY, GoalEvent::Feedback(b"half".to_vec()))]);
    lab.status("/arm", &[status(Status::Succeeded)]);
    lab.expect(&[]);
    lab.result("/arm", Status::Succeeded);
    lab.expect_end(ended(EndState::Succeeded, "said", Some(b"42")));
}

#[test]
fn a_status_from_before_the_goal_may_arrive_after_its_feedback() {
    let mut lab = Lab::sent();
    lab.feedback("/arm", b"half");
    lab.expect(&[
        accepted(),
        Effect::Event(KEY, GoalEvent::Feedback(b"half".to_vec())),
    ]);
    lab.status("/arm", &[]);
    lab.expect(&[]);
    lab.result("/arm", Status::Succeeded);
    lab.expect_end(ended(EndState::Succeeded, "said", Some(b"42")));
}

#[test]
fn each_final_state_of_the_server_is_the_end() {
    for (is, state) in [
        (Status::Succeeded, EndState::Succeeded),
        (Status::Aborted, EndState::Aborted),
        (Status::Preempted, EndState::Preempted),
    ] {
        let mut lab = Lab::sent();
        lab.result("/arm", is);
        lab.expect(&[accepted(), ended(state, "said", Some(b"42"))]);
    }
    for (is, state) in [
        (Status::Recalled, EndState::Recalled),
        (Status::Rejected, EndState::Rejected),
    ] {
        let mut lab = Lab::sent();
        lab.result("/arm", is);
        lab.expect_end(ended(state, "said", Some(b"42")));
    }
}

#[test]
fn a_goal_waits_for_all_five_topics() {
    let full = all("/arm");
    for missing in 0..5 {
        let mut lab = Lab::new();
        let mut links = full.clone();
        let topics = [
            &mut links.goal,
            &mut links.cancel,
            &mut links.status,
            &mut links.feedback,
            &mut links.result,
        ];
        *topics.into_iter().nth(missing).unwrap() = vec!["/other".into()];
        lab.links(links);
        lab.send();
        lab.expect(&[]);
        lab.links(full.clone());
        lab.expect(&[]);
        lab.pass(SETTLE);
        lab.expect(&[goal_sent()]);
    }
}

#[test]
fn a_goal_waits_until_no_connection_is_replaced_any_more() {
    let mut lab = Lab::new();
    lab.links(all("/arm"));
    lab.send();
    let mut twice = all("/arm");
    twice.goal.push("/arm".into());
    lab.pass(SETTLE / 2);
    lab.links(twice);
    lab.pass(SETTLE / 2);
    lab.links(all("/arm"));
    lab.pass(SETTLE - Duration::from_millis(1));
    lab.expect(&[]);
    lab.pass(Duration::from_millis(1));
    lab.expect(&[goal_sent()]);
}

#[test]
fn without_a_server_the_goal_is_not_sent_and_the_reason_is_asked_for() {
    let mut lab = Lab::new();
    lab.send();
    lab.pass(CONNECT - Duration::from_millis(1));
    lab.expect(&[]);
    lab.pass(Duration::from_millis(1));
    lab.expect(&[Effect::Explain(KEY)]);
    lab.links(all("/arm"));
    lab.machine
        .handle_explanation(KEY, "none".to_owned(), &mut lab.effects);
    lab.expect_end(ended(EndState::NotSent, "none", None));
}

#[test]
fn two_servers_get_no_goal() {
    let mut lab = Lab::new();
    let one = Links {
        unsettled: true,
        ..all("/a")
    };
    lab.links(one.clone());
    lab.send();
    lab.expect(&[]);
    let mut both = one;
    both.status.push("/b".into());
    lab.links(both);
    let text = "the action has more than one server, /a and /b: stop one of them";
    lab.expect_end(ended(EndState::NotSent, text, None));
}

#[test]
fn a_second_publisher_that_cannot_be_reached_stops_nothing() {
    let mut lab = Lab::new();
    lab.links(Links {
        unsettled: true,
        ..all("/arm")
    });
    lab.send();
    lab.pass(CONNECT);
    lab.expect(&[goal_sent()]);
}

#[test]
fn what_another_server_says_is_ignored() {
    let mut lab = Lab::sent();
    lab.status("/b", &[status(Status::Active)]);
    lab.result("/b", Status::Succeeded);
    lab.feedback("/b", b"");
    lab.expect(&[]);
}

#[test]
fn a_lost_result_leaves_the_true_state() {
    let mut lab = Lab::active();
    lab.status("/arm", &[status(Status::Aborted)]);
    // The server forgets the goal five seconds after its end.
    lab.status("/arm", &[]);
    lab.pass(ANSWER - Duration::from_millis(1));
    lab.expect(&[]);
    lab.pass(Duration::from_millis(1));
    lab.expect_end(ended(EndState::Aborted, "said", None));
}

#[test]
fn a_cancel_is_repeated_until_the_server_shows_it() {
    let mut lab = Lab::active();
    lab.cancel();
    lab.expect(&[cancel_sent()]);
    lab.pass(CANCEL_AGAIN);
    lab.expect(&[cancel_sent()]);
    lab.status("/arm", &[status(Status::Preempting)]);
    lab.pass(CANCEL_AGAIN * 3);
    lab.expect(&[]);
    lab.result("/arm", Status::Preempted);
    lab.expect_end(ended(EndState::Preempted, "said", Some(b"42")));
}

#[test]
fn a_cancel_before_the_goal_is_sent_sends_nothing() {
    let mut lab = Lab::new();
    lab.send();
    lab.cancel();
    lab.expect_end(ended(
        EndState::NotSent,
        "cancelled before it was sent",
        None,
    ));
    lab.links(all("/arm"));
    lab.expect(&[]);
}

#[test]
fn a_cancel_that_overtakes_its_goal_recalls_it() {
    let mut lab = Lab::sent();
    lab.cancel();
    lab.expect(&[cancel_sent()]);
    lab.status("/arm", &[status(Status::Recalling)]);
    lab.expect(&[]);
    lab.result("/arm", Status::Recalled);
    lab.expect_end(ended(EndState::Recalled, "said", Some(b"42")));
}

#[test]
fn a_goal_that_the_server_never_shows_is_unknown_and_cancelled() {
    let mut lab = Lab::sent();
    for _ in 0..ANSWER.as_secs() {
        lab.pass(Duration::from_secs(1));
        lab.status("/arm", &[]);
    }
    let text = "the action server /arm has not shown the goal in time; a cancel was sent";
    lab.expect(&[cancel_sent(), ended(EndState::Unknown, text, None)]);
    // It arrives after all.
    lab.status("/arm", &[status(Status::Active)]);
    lab.expect(&[cancel_sent()]);
}

#[test]
fn a_killed_server_is_gone_after_its_silence_and_its_goal_is_cancelled_if_it_comes_back() {
    let mut lab = Lab::active();
    lab.links(Links::default());
    lab.pass(SILENCE_CLOSED - Duration::from_millis(1));
    lab.expect(&[]);
    lab.pass(Duration::from_millis(1));
    let text = "the action server /arm is gone";
    lab.expect_end(ended(EndState::Unknown, text, None));
    lab.status("/arm", &[status(Status::Active)]);
    lab.status("/arm", &[status(Status::Active)]);
    lab.expect(&[cancel_sent()]);
    lab.pass(CANCEL_AGAIN);
    lab.status("/arm", &[status(Status::Active)]);
    lab.expect(&[cancel_sent()]);
    lab.status("/arm", &[status(Status::Preempting)]);
    lab.expect(&[]);
}

#[test]
fn a_connection_that_is_made_again_in_time_loses_nothing() {
    let mut lab = Lab::active();
    lab.links(Links::default());
    lab.pass(SILENCE_CLOSED / 2);
    lab.links(all("/arm"));
    lab.status("/arm", &[status(Status::Active)]);
    lab.pass(SILENCE_CLOSED);
    lab.expect(&[]);
    lab.result("/arm", Status::Succeeded);
    lab.expect_end(ended(EndState::Succeeded, "said", Some(b"42")));
}

#[test]
fn a_silent_server_with_an_open_connection_is_waited_for_longer() {
    let mut lab = Lab::active();
    lab.pass(SILENCE_OPEN - Duration::from_millis(1));
    lab.expect(&[]);
    lab.pass(Duration::from_millis(1));
    let text = "the action server /arm is silent";
    lab.expect_end(ended(EndState::Unknown, text, None));
}

#[test]
fn a_pause_of_the_simulation_is_no_silence() {
    let mut lab = Lab::active();
    lab.pass(SILENCE_OPEN - Duration::from_millis(1));
    lab.machine.handle_pause(lab.now);
    lab.pass(SILENCE_OPEN - Duration::from_millis(1));
    lab.expect(&[]);
    lab.links(Links::default());
    lab.machine.handle_pause(lab.now);
    lab.pass(Duration::from_millis(1));
    let text = "the action server /arm is gone";
    lab.expect_end(ended(EndState::Unknown, text, None));
}

#[test]
fn a_restarted_server_does_not_know_the_goal() {
    let mut lab = Lab::active();
    lab.links(Links::default());
    lab.links(all("/arm"));
    lab.status("/arm", &[]);
    let text = "the action server /arm was restarted and does not know the goal";
    lab.expect_end(ended(EndState::Unknown, text, None));
}

#[test]
fn states_that_no_server_may_say_are_unknown() {
    let mut lab = Lab::sent();
    lab.status("/arm", &[status(Status::Other(9))]);
    let text = "the action server /arm shows the goal in the state 9";
    lab.expect_end(ended(EndState::Unknown, text, None));
    let mut lab = Lab::sent();
    lab.result("/arm", Status::Active);
    let text = "the action server /arm sent a result in the state Active";
    lab.expect_end(ended(EndState::Unknown, text, None));
}

#[test]
fn what_is_remembered_of_unknown_goals_is_bounded() {
    let mut lab = Lab::new();
    lab.links(all("/arm"));
    for round in 0..MOST_ORPHANS * 2 {
        let key = GoalKey(u32::try_from(round).unwrap());
        lab.machine.send(lab.now, key, Vec::new(), &mut lab.effects);
    }
    lab.pass(SILENCE_OPEN);
    assert_eq!(lab.machine.orphans.len(), MOST_ORPHANS);
    lab.pass(ORPHAN);
    assert!(lab.machine.orphans.is_empty());
}

#[test]
fn a_node_that_connects_again_for_cancels_gets_those_that_it_may_have_missed() {
    let without = Links {
        cancel: Vec::new(),
        ..all("/arm")
    };
    let mut lab = Lab::active();
    lab.links(without.clone());
    lab.links(all("/arm"));
    lab.expect(&[]);
    lab.cancel();
    lab.expect(&[cancel_sent()]);
    lab.links(without.clone());
    lab.expect(&[]);
    lab.links(all("/arm"));
    lab.expect(&[cancel_sent()]);
    lab.links(all("/arm"));
    lab.expect(&[]);
    lab.pass(SILENCE_OPEN);
    lab.effects.clear();
    // Its outcome is unknown now.
    assert!(lab.machine.goals.is_empty());
    lab.links(without);
    lab.links(all("/arm"));
    lab.expect(&[cancel_sent()]);
}
