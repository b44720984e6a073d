//! `docs/c.md` shows the real example.

use crate::build::root;

#[test]
fn the_documented_handler_matches_the_example() {
    let page = std::fs::read_to_string(root().join("docs/c.md")).expect("docs/c.md");
    let example = std::fs::read_to_string(root().join("examples/c/worker.c")).expect("worker.c");
    let block = page
        .split("```c\n")
        .nth(1)
        .and_then(|rest| rest.split("```").next());
    let block = block.expect("a block of C");
    let mut lines = example.lines();
    for line in block.lines() {
        // Left out in between is what a first look does not need.
        assert!(
            lines.any(|there| there == line),
            "worker.c has no such line there: {line}"
        );
    }
}
