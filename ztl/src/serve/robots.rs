//! Files for known robots, to begin with: the examples, which tests play.

use clap::builder::PossibleValuesParser;

/// Each robot and its file.
const ROBOTS: [(&str, &str); 7] = [
    ("nao", include_str!("robots/nao.yaml")),
    ("pepper", include_str!("robots/pepper.yaml")),
    ("misty", include_str!("robots/misty.yaml")),
    ("reachy-mini", include_str!("robots/reachy-mini.yaml")),
    ("fetch", include_str!("robots/fetch.yaml")),
    ("care-o-bot-4", include_str!("robots/care-o-bot-4.yaml")),
    ("turtlebot3", include_str!("robots/turtlebot3.yaml")),
];

/// The names of the robots.
pub(super) fn names() -> PossibleValuesParser {
    PossibleValuesParser::new(ROBOTS.map(|(name, _)| name))
}

/// The file for a robot.
pub(super) fn file(name: &str) -> &'static str {
    let found = ROBOTS.iter().find(|(robot, _)| *robot == name);
    found.map_or("", |(_, file)| file)
}
