use super::*;

fn stamped(event: RunEvent) -> StampedEvent {
    StampedEvent {
        at: Duration::from_micros(1_234_567),
        wall: SystemTime::UNIX_EPOCH + Duration::from_millis(1_763_740_800_250),
        event,
    }
}

#[test]
fn an_event_is_one_line_with_both_times() {
    let line = serde_json::to_string(&stamped(RunEvent::Key {
        key: "Enter".to_owned(),
        command: Some(RunCommand::Jump { scene: 2 }),
    }))
    .unwrap();
    assert_eq!(
        line,
        r#"{"at_ms":1234.567,"wall":"2025-11-21T16:00:00.250000Z","event":"key","key":"Enter","command":{"do":"jump","scene":2}}"#
    );
}

#[test]
fn an_event_survives_a_round_trip() {
    let outline = Outline {
        scenes: vec![SceneOutline {
            name: "a\n\"b\"".to_owned(),
            delay: Duration::from_micros(1),
            steps: vec![StepOutline {
                name: "s".to_owned(),
                delay: Duration::ZERO,
                wait: true,
                parallel: false,
                tasks: vec![TaskOutline {
                    handler: "h".to_owned(),
                    component: "c".to_owned(),
                    goal: "g".to_owned(),
                    remote: "r".to_owned(),
                    delay: Duration::from_millis(1500),
                    wait: false,
                    limit: Some(Duration::from_secs(3)),
                }],
                key: None,
            }],
        }],
        cues: Vec::new(),
    };
    let events = [
        RunEvent::RunStarted(Box::new(RunStarted {
            format: FORMAT,
            script: "s.yaml".to_owned(),
            sha256: String::new(),
            config: None,
            options: vec!["--yes".to_owned()],
            versions: vec![("ztl".to_owned(), "0.1.0".to_owned())],
            remotes: Vec::new(),
            outline,
        })),
        RunEvent::Resumed,
        RunEvent::Asked {
            question: Question::Step { scene: 1, step: 2 },
            choices: vec![RunCommand::Retry, RunCommand::GoOn, RunCommand::Stop],
        },
        RunEvent::StepWaiting {
            scene: 0,
            step: 0,
            why: WaitReason::ServerSilent {
                remote: "robot".to_owned(),
            },
            tasks: vec![TaskNumber(7)],
        },
        RunEvent::Answered {
            request: RequestNumber(9),
            latency: Duration::from_micros(321),
            state: 1,
            id: "-99999999999999999999".parse().unwrap(),
            text: String::new(),
        },
    ];
    for event in events {
        let line = serde_json::to_string(&stamped(event.clone())).unwrap();
        assert!(!line.contains('\n'), "{line}");
        let read: StampedEvent = serde_json::from_str(&line).unwrap();
        assert_eq!(read, stamped(event), "{line}");
    }
}

#[test]
fn an_event_of_a_newer_version_is_unknown() {
    let line = r#"{"at_ms":0,"wall":"2025-11-21T16:00:00Z","event":"eclipse","of":"sun"}"#;
    let read: StampedEvent = serde_json::from_str(line).unwrap();
    assert_eq!(read.event, RunEvent::Unknown);
}

#[test]
fn an_impossible_time_is_rejected() {
    for at in ["-1", "1e300", "\"1\""] {
        let line = format!(r#"{{"at_ms":{at},"wall":"2025-11-21T16:00:00Z","event":"resumed"}}"#);
        assert!(
            serde_json::from_str::<StampedEvent>(&line).is_err(),
            "{line}"
        );
    }
}
