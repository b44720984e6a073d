mod notes;
mod stopping;

use ztl_script::event::{
    DecidedBy, Question, RunCommand, RunEvent, RunOutcome, StampedEvent, StepOutline, TaskNumber,
    TaskState, WaitReason,
};
use ztl_script::record::read;

use super::super::rows::percent;
use super::super::text::Capabilities;
use super::*;
use ztl_script::board::{Progress, StepRun};

const UNICODE: Capabilities = Capabilities {
    colour: false,
    utf8: true,
};
const ASCII: Capabilities = Capabilities {
    colour: false,
    utf8: false,
};
const EVENING: &str = include_str!("../../../../ztl-script/src/fixtures/evening.jsonl");

fn evening() -> Vec<StampedEvent> {
    let (mut runs, damage) = read("evening.jsonl", EVENING.as_bytes()).unwrap();
    assert_eq!(damage, []);
    runs.remove(0).events
}

/// The state after the first event for which `until` is true, and its time.
fn board(mut until: impl FnMut(&RunEvent) -> bool) -> (RunBoard, Duration) {
    let mut board = RunBoard::default();
    for event in evening() {
        board.handle(&event);
        if until(&event.event) {
            return (board, event.at);
        }
    }
    panic!("that never happens");
}

/// The screen as text; each line without the blanks at its end.
fn screen(board: &RunBoard, now: Duration, size: (usize, usize)) -> String {
    let (lines, _) = draw(board, &View::default(), now, size);
    assert_eq!(lines.len(), size.1);
    let text = lines.iter().map(|line| {
        assert!(line.width() <= size.0, "{line:?}");
        line.encoded(UNICODE)
    });
    let text: Vec<String> = text
        .map(|line| {
            let mut line = line;
            for code in ["\x1b[0m", "\x1b[1m", "\x1b[2m", "\x1b[7m"] {
                line = line.replace(code, "");
            }
            line.trim_end().to_owned()
        })
        .collect();
    text.join("\n")
}

#[test]
fn a_scene_is_shown_with_all_its_tasks() {
    let (board, at) = board(|event| matches!(event, RunEvent::Asked { .. }));
    assert_eq!(
        format!(
            "\n{}",
            screen(&board, at + Duration::from_millis(300), (80, 18))
        ),
        "
 evening.yaml   scene 1 of 4                                              0.3 s
 servers  robot ·  light ·  speech ✗ MISSING
 · 1 Welcome
     · look up
         robot [head] -> [0, 0.4]
     · greet
         robot [say] -> Hello, I am <Ada> & I dance
         robot [arm] -> wave
     · light on                                                    in background
         light [ring] -> {'colour': 'warm', 'level': 0.8}
 · 2 Dance                                                           after 1.0 s
 · 3 Questions
 · 4 Goodbye
────────────────────────────────────────────────────────────────────────────────
 Next: Welcome
 MISSING: server 'speech': no valid entry in the configuration
  Enter  start   s  skip   j  jump to a scene   x  stop everything   d  details
  ?  keys"
    );
}

#[test]
fn a_silent_server_is_shown_with_the_tasks_waiting_for_it() {
    let silent = |event: &RunEvent| {
        matches!(
            event,
            RunEvent::StepWaiting {
                why: WaitReason::ServerSilent { .. },
                ..
            }
        )
    };
    let mut seen = false;
    let (board, at) = board(|event| {
        seen |= silent(event);
        seen && matches!(event, RunEvent::Asked { .. })
    });
    assert_eq!(
        format!(
            "\n{}",
            screen(&board, at + Duration::from_millis(1200), (80, 22))
        ),
        "
 evening.yaml   scene 2 of 4                                             21.0 s
 servers  robot silent for 1.2 s  light ✓ 2 ms  speech ✗ MISSING
 ✗ 1 Welcome                                                               6.5 s
 ▶ 2 Dance                                                                 6.2 s
     ▶ turn                                                                5.2 s
         ? robot:base:[0, 0, 1.57]  unknown  no answer for 2.0 s           4.7 s
         ▶ robot:arm:up  accepted                                          3.7 s
     · bow                                                              parallel
 · 3 Questions
 · 4 Goodbye



─ in the background: 1 ─────────────────────────────────────────────────────────
   ▶ light:ring:{'colour': 'warm', 'level': 0.8}  accepted                15.8 s
────────────────────────────────────────────────────────────────────────────────
 WAITING: server 'robot' is silent for 1.2 s; what its tasks do is unknown.
   Decide.
   unknown: no answer for 2.0 s (robot:base:[0, 0, 1.57])
   accepted (robot:arm:up)
  g  go on anyway   c  stop this scene   x  stop everything   d  details
  ?  keys"
    );
    let seen = screen(&board, at + Duration::from_millis(1200), (80, 22));
    let seen: Vec<&str> = seen.lines().filter(|line| !line.is_empty()).collect();
    let docs = include_str!("../../../../docs/show.md");
    assert!(docs.contains(&seen.join("\n")), "docs/show.md shows this");
}

/// The line of keys, with blanks as they come.
fn key_line(board: &RunBoard) -> String {
    let keys = keys::help(board);
    let keys: Vec<String> = keys
        .iter()
        .map(|(key, does)| format!("{key} {does}"))
        .collect();
    keys.join(", ")
}

#[test]
fn keys_without_an_effect_are_not_offered_outside_a_scene() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::SceneEnded { .. }));
    assert!(board.in_background().count() > 0);
    assert!(board.question.is_none());
    assert_eq!(key_line(&board), "x stop everything, d details, ? keys");
    let next = |event| StampedEvent {
        at,
        event,
        ..evening().remove(0)
    };
    let choices = vec![
        RunCommand::Start,
        RunCommand::StopAll,
        RunCommand::Stop,
        RunCommand::Leave,
    ];
    let question = Question::Scene { scene: 1 };
    board.handle(&next(RunEvent::Asked { question, choices }));
    let offered = "Enter start, q leave (1 task runs on), x stop everything, d details, ? keys";
    assert_eq!(key_line(&board), offered);
    let leave = RunEvent::Decided {
        command: RunCommand::Leave,
        by: DecidedBy::Operator,
        scene: None,
        step: None,
    };
    board.handle(&next(leave));
    let offered = "Ctrl-C leave without waiting, d details, ? keys";
    assert_eq!(key_line(&board), offered);
}

#[test]
fn a_small_screen_keeps_the_pending_decision() {
    let (board, at) = board(|event| {
        matches!(
            event,
            RunEvent::Asked {
                question: Question::Step { step: 2, .. },
                ..
            }
        )
    });
    assert_eq!(
        format!("\n{}", screen(&board, at, (44, 8))),
        "
 WAITING: something failed. Decide.
   rejected: busy: 'ring' is in use; it
     takes one task at a time
     (light:ring:{'colour': 'warm', 'level':
     0.8})
  t  retry what failed   g  go on anyway
  c  stop this scene   x  stop everything
  d  details   ?  keys"
    );
    // The available keys are visible on the smallest screen.
    assert!(screen(&board, at, (80, 1)).contains("x  stop everything"));
}

#[test]
fn a_terminal_of_any_size_is_filled_exactly() {
    let mut board = RunBoard::default();
    for event in evening() {
        board.handle(&event);
        for size in [
            (0, 0),
            (1, 1),
            (3, 200),
            (20, 5),
            (79, 23),
            (80, 24),
            (300, 2),
            (33, 11),
        ] {
            let panes = [
                Pane::Show,
                Pane::Choose(Chooser::at(3)),
                Pane::Keys,
                Pane::Details,
                Pane::Cues,
            ];
            for (pane, top) in panes
                .into_iter()
                .flat_map(|pane| [(pane.clone(), None), (pane, Some(7))])
            {
                let (lines, _) = draw(&board, &View { pane, top }, event.at, size);
                assert_eq!(lines.len(), size.1);
                assert!(lines.iter().all(|line| line.width() <= size.0), "{size:?}");
            }
        }
    }
}

#[test]
fn cues_are_shown_with_the_keys_that_start_them() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::StepStarted { .. }));
    let one = board.outline.scenes[0].steps[0].clone();
    let cue = |name: &str, key| StepOutline {
        name: name.to_owned(),
        key,
        ..one.clone()
    };
    board.outline.cues = vec![
        cue("wave", Some('w')),
        cue("say", Some('s')),
        cue("halt", Some('x')),
        cue("bow", None),
    ];
    let shown = screen(&board, at, (80, 24));
    assert!(
        shown.contains(" cues   w  wave ·   k s  say ·   halt ·   bow ·"),
        "{shown}"
    );
    let cues = &board.outline.cues;
    let pressed = |key, on_page| keys::cue(key, cues, on_page);
    assert_eq!([pressed("W", false), pressed("w", true)], [Some(0); 2]);
    assert_eq!([pressed("s", false), pressed("s", true)], [None, Some(1)]);
    assert_eq!([pressed("x", false), pressed("x", true)], [None; 2]);
}

#[test]
fn wide_names_of_servers_and_cues_are_wrapped_before_they_are_cut() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::StepStarted { .. }));
    let one = board.outline.scenes[0].steps[0].clone();
    for nth in 0..4 {
        let name = format!("日本語の名前{nth}");
        board.servers.push((name.clone(), ServerView::default()));
        board.outline.cues.push(StepOutline {
            name,
            key: None,
            ..one.clone()
        });
    }
    let shown = screen(&board, at, (50, 30));
    for nth in 0..4 {
        let count = shown.matches(&format!("名前{nth} ·")).count();
        assert_eq!(count, 2, "{nth} in\n{shown}");
    }
}

#[test]
fn the_current_step_stays_visible_among_a_thousand() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::StepStarted { .. }));
    let scene = &mut board.outline.scenes[0];
    let one = scene.steps[0].clone();
    let many = (0..1000).map(|nth| StepOutline {
        name: format!("step {nth}"),
        ..one.clone()
    });
    scene.steps = many.collect();
    let played = board.played.as_mut().unwrap();
    played.steps = vec![StepRun::default(); 1000];
    played.steps[500].progress = Progress::Playing;
    let screen = screen(&board, at, (60, 20));
    assert!(screen.contains("▶ step 500"), "{screen}");
    assert!(screen.contains(" more lines"), "{screen}");
}

#[test]
fn progress_in_percent_is_a_bar() {
    let (board, at) =
        board(|event| matches!(event, RunEvent::TaskState { text, .. } if text == "50 %"));
    let screen = screen(&board, at, (80, 24));
    assert!(
        screen.contains("▶ robot:head:[0, 0.4]  accepted  █████░░░░░ 50 %"),
        "{screen}"
    );
    assert_eq!(
        [
            percent("7.9 %"),
            percent("101 %"),
            percent("50"),
            percent("-1%")
        ],
        [Some(7), None, None, None]
    );
}

#[test]
fn the_final_screen_shows_the_result_of_the_run() {
    let (board, _) = board(|event| matches!(event, RunEvent::RunEnded { .. }));
    let lines: Vec<String> = summary(&board, 80)
        .iter()
        .map(|line| line.encoded(ASCII))
        .collect();
    let text = lines.join("\n");
    for part in [
        " ! ",
        "2 Dance",
        "skipped",
        "# ",
        "aborted",
        "Over: everything was stopped.",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
}

#[test]
fn long_lists_scroll_by_pages() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::Asked { .. }));
    let scene = board.outline.scenes[0].clone();
    let many = (0..200).map(|nth| ztl_script::event::SceneOutline {
        name: format!("scene {nth}"),
        ..scene.clone()
    });
    board.outline.scenes = many.collect();
    board.scenes = vec![Progress::Pending; 200];
    let seen = |top| {
        let view = View {
            pane: Pane::Show,
            top,
        };
        let (lines, seen) = draw(&board, &view, at, (80, 24));
        let text: Vec<String> = lines.iter().map(|line| line.encoded(ASCII)).collect();
        (text.join("\n"), seen)
    };
    let (screen, usual) = seen(None);
    assert!(screen.contains("1 scene 0") && usual.from == 0, "{screen}");
    let (screen, next) = seen(Some(usual.height - 1));
    assert!(!screen.contains("1 scene 0"), "{screen}");
    assert!(
        screen.contains("Next: scene 0"),
        "what Enter starts: {screen}"
    );
    assert_eq!(next.from, usual.height - 1);
    let (screen, last) = seen(Some(usize::MAX));
    assert!(screen.contains("200 scene 199"), "{screen}");
    assert!(last.from > 150);
}

#[test]
fn a_reason_comes_first_and_in_full_on_its_own_page() {
    let (mut board, at) = board(|event| {
        matches!(
            event,
            RunEvent::Asked {
                question: Question::Step { step: 2, .. },
                ..
            }
        )
    });
    let long = "because ".repeat(40) + "of this";
    for task in board.tasks.values_mut() {
        task.text.clone_from(&long);
        task.name = "n".repeat(500);
    }
    let shown = screen(&board, at, (60, 24));
    let flat = |screen: &str| screen.split_whitespace().collect::<Vec<_>>().join(" ");
    let expected = format!("rejected: {long} (nnn");
    assert!(flat(&shown).contains(&expected), "{shown}");
    // On a small one as much as there is room for, and the page has the rest.
    let shown = screen(&board, at, (40, 9));
    assert!(shown.contains("rejected: because") && shown.contains("d shows the rest"));
    let view = View {
        pane: Pane::Details,
        top: Some(0),
    };
    let (lines, _) = draw(&board, &view, at, (60, 60));
    let page: Vec<String> = lines.iter().map(|line| line.encoded(ASCII)).collect();
    assert!(flat(&page.join("\n")).contains(&expected), "{page:?}");
}

#[test]
fn every_available_key_is_explained() {
    let mut board = RunBoard::default();
    for event in evening() {
        board.handle(&event);
        for (key, _) in keys::help(&board) {
            assert!(keys::ALL.iter().any(|(known, _)| *known == key), "{key}");
        }
    }
}

/// The board with this event more.
fn and(board: &mut RunBoard, at: Duration, event: RunEvent) {
    board.handle(&StampedEvent {
        at,
        event,
        ..evening().remove(0)
    });
}

#[test]
fn a_narrow_window_keeps_the_message_and_keys() {
    let asked = |event: &RunEvent| matches!(event, RunEvent::Asked { .. });
    let (first, at) = board(asked);
    let shown = screen(&first, at, (30, 6));
    for part in ["Next: Welcome", "Enter  start", "x  stop everything"] {
        assert!(shown.contains(part), "{part} in\n{shown}");
    }
    let (step, at) = board(|event| {
        let step = |question: &Question| matches!(question, Question::Step { .. });
        matches!(event, RunEvent::Asked { question, .. } if step(question))
    });
    for height in 2..7 {
        let shown = screen(&step, at, (30, height));
        for part in [" WAITING: ", "x  stop everything"] {
            assert!(shown.contains(part), "{part} in\n{shown}");
        }
    }
}
