//! What is shown while robots are stopped.

use super::*;

#[test]
fn each_confirmation_of_stopping_is_shown() {
    let mut answers = 0;
    let (board, at) = board(|event| {
        answers += usize::from(matches!(event, RunEvent::StopAnswered { .. }));
        answers == 2
    });
    let screen = screen(&board, at, (80, 24));
    let message: Vec<&str> = screen.lines().skip(19).collect();
    assert_eq!(
        message,
        [
            " STOPPING EVERYTHING: 2 of 3 confirmed",
            "   ? robot:say:Goodbye: no answer yet",
            "   ✓ light:ring:{'colour': 'warm', 'level': 0.8}: aborted",
            "   ✓ robot:arm:wave: aborted",
            "  Ctrl-C  leave without waiting   d  details   ?  keys",
        ]
    );
}

#[test]
fn a_refused_stop_never_counts_as_confirmed() {
    let mut answers = 0;
    let (mut board, at) = board(|event| {
        answers += usize::from(matches!(event, RunEvent::StopAnswered { .. }));
        answers == 2
    });
    let refused = RunEvent::StopAnswered {
        task: TaskNumber(14),
        confirmed: false,
        text: "it cannot be stopped, and continues (False)".to_owned(),
    };
    and(&mut board, at, refused);
    let screen = screen(&board, at, (80, 24));
    assert!(!screen.contains("all confirmed"), "{screen}");
    for part in [
        "STOPPING EVERYTHING: 2 of 3 confirmed, 1 may still move",
        "✗ robot:say:Goodbye: it cannot be stopped, and continues (False)",
    ] {
        assert!(screen.contains(part), "{part} in\n{screen}");
    }
}

#[test]
fn nothing_is_confirmed_while_servers_are_still_asked() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::Asked { .. }));
    let stop = RunEvent::Decided {
        command: RunCommand::StopAll,
        by: DecidedBy::Operator,
        scene: None,
        step: None,
    };
    and(&mut board, at, stop);
    let remotes = vec!["light".to_owned(), "robot".to_owned()];
    let tasks = Vec::new();
    and(&mut board, at, RunEvent::Stopping { tasks, remotes });
    let listed = |remote: &str, gaps: &[&str]| RunEvent::TasksListed {
        remote: remote.to_owned(),
        gaps: gaps.iter().map(ToString::to_string).collect(),
    };
    let shows = |board: &RunBoard, head: &str| {
        let screen = screen(board, at, (80, 24));
        assert!(
            screen.contains(&format!("\n {head}\n")),
            "{head} in\n{screen}"
        );
    };
    shows(
        &board,
        "STOPPING EVERYTHING: asking 2 servers which tasks run",
    );
    and(&mut board, at, listed("light", &["no answer for 2.0 s"]));
    shows(
        &board,
        "STOPPING EVERYTHING: asking 'robot' which tasks run",
    );
    let found = RunEvent::TaskFound {
        task: TaskNumber(1),
        remote: "robot".to_owned(),
        id: "7".parse().unwrap(),
        text: "robot:arm:up".to_owned(),
    };
    and(&mut board, at, found);
    and(&mut board, at, listed("robot", &[]));
    shows(&board, "STOPPING EVERYTHING: 0 of 1 confirmed");
    let ended = RunEvent::StopAnswered {
        task: TaskNumber(1),
        confirmed: true,
        text: "aborted".to_owned(),
    };
    and(&mut board, at, ended);
    shows(&board, "STOPPING EVERYTHING: 1 of 1 confirmed");
    let question = Question::Scene { scene: 0 };
    let choices = vec![RunCommand::Start];
    and(&mut board, at, RunEvent::Asked { question, choices });
    // Nobody knows what 'light' does.
    let screen = screen(&board, at, (100, 24));
    let head =
        "STOPPED WHAT IS KNOWN: 1 of 1 confirmed; what others started on 'light' may still run";
    assert!(screen.contains(head), "{screen}");
}

#[test]
fn stopped_is_shown_only_after_every_confirmation() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::RunEnded { .. }));
    let running = vec![TaskNumber(1), TaskNumber(2)];
    for (running, said) in [
        (running, "2 tasks; they may still run"),
        (vec![TaskNumber(1)], "1 task; it may still run"),
    ] {
        let ended = RunEvent::RunEnded {
            outcome: RunOutcome::NotConfirmed,
            running,
            text: String::new(),
        };
        and(&mut board, at, ended);
        let lines = summary(&board, 80);
        let text: Vec<String> = lines.iter().map(|line| line.encoded(ASCII)).collect();
        let text = text.join("\n");
        let said = format!("Over: stopping was not confirmed for {said}");
        assert!(text.contains(&said), "{said} in {text}");
        assert!(!text.contains("everything was stopped"), "{text}");
    }
}

#[test]
fn a_task_that_ends_after_its_stop_timed_out_counts_as_stopped() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::Stopping { .. }));
    let tasks: Vec<TaskNumber> = board
        .stopping
        .as_ref()
        .unwrap()
        .answers
        .keys()
        .copied()
        .collect();
    for task in &tasks {
        let told = RunEvent::StopAnswered {
            task: *task,
            confirmed: false,
            text: "it has not ended yet (True)".to_owned(),
        };
        and(&mut board, at, told);
    }
    let question = Question::Scene { scene: 0 };
    let choices = vec![RunCommand::Start, RunCommand::StopAll];
    and(&mut board, at, RunEvent::Asked { question, choices });
    let all = tasks.len();
    let shown = screen(&board, at, (80, 24));
    assert!(
        shown.contains(&format!("STOPPED ONLY 0 OF {all}")),
        "{shown}"
    );
    for task in tasks {
        let ended = RunEvent::TaskState {
            task,
            state: TaskState::Aborted,
            id: None,
            text: "True".to_owned(),
            no_server: false,
        };
        and(&mut board, at, ended);
    }
    let shown = screen(&board, at, (80, 24));
    assert!(
        shown.contains(&format!("{all} of {all} confirmed")),
        "{shown}"
    );
    assert!(!shown.contains("it has not ended yet"), "{shown}");
}
