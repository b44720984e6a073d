//! Notes, until the operator has seen them.

use super::*;

/// The state before the first scene, with notes about so many servers.
fn noted(count: usize) -> (RunBoard, Duration) {
    let (mut board, at) = board(|event| matches!(event, RunEvent::Asked { .. }));
    for server in 1..=count {
        let text = format!("tasks on 'server{server}' may still run");
        and(&mut board, at, RunEvent::Note { text });
    }
    (board, at)
}

/// The servers whose notes this screen shows.
fn shown(screen: &str) -> Vec<usize> {
    let is_shown = |server: &usize| screen.contains(&format!("'server{server}' may still run"));
    (1..20).filter(is_shown).collect()
}

#[test]
fn the_newest_notes_are_shown_and_the_page_of_details_has_all() {
    let (mut board, at) = noted(5);
    board.servers.clear();
    let shows = screen(&board, at, (80, 24));
    assert_eq!(shown(&shows), [3, 4, 5], "{shows}");
    assert!(shows.contains(" and 2 more notes\n"), "{shows}");
    assert!(shows.contains("d  details"), "{shows}");
    let view = View::of(Pane::Details);
    let (lines, _) = draw(&board, &view, at, (80, 40));
    let page: Vec<String> = lines.iter().map(|line| line.encoded(ASCII)).collect();
    assert_eq!(shown(&page.join("\n")), [1, 2, 3, 4, 5], "{page:?}");
    // Also after they were seen.
    board.see_notes(&[0, 1, 2, 3, 4]);
    assert!(shown(&screen(&board, at, (80, 24))).is_empty());
    let (lines, _) = draw(&board, &view, at, (80, 40));
    let page: Vec<String> = lines.iter().map(|line| line.encoded(ASCII)).collect();
    assert_eq!(shown(&page.join("\n")), [1, 2, 3, 4, 5], "{page:?}");
    assert!(board.has_details());
}

#[test]
fn only_notes_that_were_drawn_count_as_seen() {
    let (mut board, at) = noted(5);
    let seen = |board: &RunBoard, size| draw(board, &View::default(), at, size).1.notes;
    assert_eq!(seen(&board, (80, 24)), [2, 3, 4]);
    assert!(seen(&board, (80, 1)).is_empty());
    // The message is cut after the first of them.
    assert_eq!(seen(&board, (80, 6)), [2]);
    let chooser = View::of(Pane::Choose(Chooser::at(0)));
    assert!(draw(&board, &chooser, at, (80, 24)).1.notes.is_empty());
    let key = RunEvent::Key {
        key: "s".to_owned(),
        command: None,
    };
    and(&mut board, at, key);
    board.see_notes(&seen(&board, (80, 24)));
    assert_eq!(shown(&screen(&board, at, (80, 24))), [1, 2]);
}

#[test]
fn the_page_of_details_names_each_missing_server() {
    let (mut board, at) = board(|event| matches!(event, RunEvent::Asked { .. }));
    for server in 1..=12 {
        let remote = format!("server{server}");
        let text = "no answer for 3.0 s".to_owned();
        let state = ServerState::Absent { text };
        and(&mut board, at, RunEvent::Server { remote, state });
    }
    let shows = screen(&board, at, (80, 40));
    assert!(
        shows.contains("MISSING: servers 'server1', 'server2' and 10 more: no answer for 3.0 s"),
        "{shows}"
    );
    let (lines, _) = draw(&board, &View::of(Pane::Details), at, (80, 40));
    let page: Vec<String> = lines.iter().map(|line| line.encoded(ASCII)).collect();
    let page = page.join("\n");
    for server in 1..=12 {
        assert!(page.contains(&format!("'server{server}'")), "{page}");
    }
}
