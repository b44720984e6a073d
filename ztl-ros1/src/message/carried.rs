//! Definitions for robots whose files are lacking: `carried.txt`, the fields of ROS's own definitions, without their
//! comments. Their md5 sums are those of ROS.

const TEXT: &str = include_str!("carried.txt");

/// The sections of the file: kind, name and text.
fn sections() -> impl Iterator<Item = (&'static str, &'static str, &'static str)> {
    // Before the first one are the source and the licence.
    TEXT.split("\n== ").skip(1).filter_map(|section| {
        let (title, text) = section.split_once('\n').unwrap_or((section, ""));
        let (kind, name) = title.split_once(' ')?;
        Some((kind, name, text))
    })
}

/// The text of a definition.
pub(super) fn text(package: &str, kind: &str, name: &str) -> Option<&'static str> {
    let meant = |known: &str| known.split_once('/') == Some((package, name));
    let mut found = sections().filter(|(known, name, _)| *known == kind && meant(name));
    found.next().map(|(_, _, text)| text)
}

/// The names of all definitions of a kind.
pub(super) fn names(kind: &str) -> impl Iterator<Item = &'static str> {
    sections()
        .filter(move |(known, _, _)| *known == kind)
        .map(|(_, name, _)| name)
}
