//! The chooser: finds a scene by its number, a part of its name, or by moving.

use ztl_script::event::SceneOutline;

/// Longest input in bytes, so that a paste cannot make each search slower.
const LONGEST: usize = 200;

/// The input so far, and the scene that Enter shows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Chooser {
    pub(super) typed: String,
    /// `None` if no scene matches.
    pub(super) cursor: Option<usize>,
}

/// The effect of a key.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Chosen {
    /// The chooser stays open.
    Stay,
    /// This scene was chosen.
    Scene(usize),
    /// The key is not for the chooser.
    Nothing,
}

impl Chooser {
    pub(super) const fn at(scene: usize) -> Self {
        Self {
            typed: String::new(),
            cursor: Some(scene),
        }
    }

    /// Whether the input is a number and not part of a name.
    fn is_number(&self) -> bool {
        !self.typed.is_empty() && self.typed.bytes().all(|byte| byte.is_ascii_digit())
    }

    /// The scenes in the list: all for a number, otherwise those whose names contain the input.
    pub(super) fn rows(&self, scenes: &[SceneOutline]) -> Vec<usize> {
        let part = match self.is_number() {
            true => String::new(),
            false => self.typed.to_lowercase(),
        };
        let has = |scene: &SceneOutline| scene.name.to_lowercase().contains(&part);
        let all = scenes.iter().enumerate();
        all.filter(|(_, scene)| has(scene))
            .map(|(nth, _)| nth)
            .collect()
    }

    /// Handles a key; `page` is the number of visible lines.
    pub(super) fn press(&mut self, key: &str, scenes: &[SceneOutline], page: usize) -> Chosen {
        let page = page.saturating_sub(1).max(1);
        match key {
            "Enter" => return self.cursor.map_or(Chosen::Stay, Chosen::Scene),
            "Up" => self.go(scenes, |at, _| at.saturating_sub(1)),
            "Down" => self.go(scenes, |at, _| at + 1),
            "PageUp" => self.go(scenes, |at, _| at.saturating_sub(page)),
            "PageDown" => self.go(scenes, |at, _| at + page),
            "Home" => self.go(scenes, |_, _| 0),
            "End" => self.go(scenes, |_, last| last),
            "Backspace" => {
                self.typed.pop();
                self.find(scenes);
            }
            "Space" => self.add(' ', scenes),
            key => {
                let mut chars = key.chars();
                match (chars.next(), chars.next()) {
                    (Some(char), None) => self.add(char, scenes),
                    _ => return Chosen::Nothing,
                }
            }
        }
        Chosen::Stay
    }

    fn add(&mut self, char: char, scenes: &[SceneOutline]) {
        if self.typed.len() < LONGEST {
            self.typed.push(char);
            self.find(scenes);
        }
    }

    /// Moves the cursor to the match.
    fn find(&mut self, scenes: &[SceneOutline]) {
        let rows = self.rows(scenes);
        self.cursor = if self.is_number() {
            let number = self.typed.parse::<usize>().ok();
            let nth = number.and_then(|number| number.checked_sub(1));
            nth.filter(|nth| *nth < scenes.len())
        } else {
            // Stays where it is if that matches.
            let stays = self.cursor.filter(|cursor| rows.contains(cursor));
            stays.or_else(|| rows.first().copied())
        };
    }

    /// Moves among the rows. Clears a typed number.
    fn go(&mut self, scenes: &[SceneOutline], to: impl FnOnce(usize, usize) -> usize) {
        if self.is_number() {
            self.typed.clear();
        }
        let rows = self.rows(scenes);
        let at = rows.iter().position(|row| Some(*row) == self.cursor);
        let last = rows.len().saturating_sub(1);
        let to = to(at.unwrap_or(0), last).min(last);
        self.cursor = rows.get(to).copied();
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn scenes(names: &[&str]) -> Vec<SceneOutline> {
        let scene = |name: &&str| SceneOutline {
            name: (*name).to_owned(),
            delay: Duration::ZERO,
            steps: Vec::new(),
        };
        names.iter().map(scene).collect()
    }

    /// The input and cursor after these keys, from the first scene.
    fn typed(keys: &[&str], scenes: &[SceneOutline]) -> (String, Option<usize>) {
        let mut chooser = Chooser::at(0);
        for key in keys {
            assert_eq!(chooser.press(key, scenes, 10), Chosen::Stay, "{key}");
        }
        (chooser.typed, chooser.cursor)
    }

    #[test]
    fn a_number_selects_a_scene() {
        let names: Vec<String> = (1..=120).map(|nth| format!("scene of {nth}")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let scenes = scenes(&names);
        assert_eq!(typed(&["2"], &scenes).1, Some(1));
        assert_eq!(typed(&["2", "4"], &scenes).1, Some(23));
        assert_eq!(typed(&["1", "2", "0"], &scenes).1, Some(119));
        assert_eq!(typed(&["1", "2", "1"], &scenes).1, None, "there is none");
        assert_eq!(typed(&["0"], &scenes).1, None);
        let (typed, at) = typed(&["1", "2", "1", "Backspace"], &scenes);
        assert_eq!((typed.as_str(), at), ("12", Some(11)));
        let mut chooser = Chooser::at(3);
        for digit in ["9", "9", "9"] {
            chooser.press(digit, &scenes, 10);
        }
        assert_eq!(chooser.press("Enter", &scenes, 10), Chosen::Stay);
        assert_eq!(chooser.press("Esc", &scenes, 10), Chosen::Nothing);
        chooser.press("Down", &scenes, 10);
        assert_eq!((chooser.typed.as_str(), chooser.cursor), ("", Some(1)));
        assert_eq!(chooser.press("Enter", &scenes, 10), Chosen::Scene(1));
    }

    #[test]
    fn letters_search_names_and_moving_stays_among_the_matches() {
        let scenes = scenes(&["Welcome", "Dance 1", "Questions", "Dance 2", "Goodbye"]);
        assert_eq!(typed(&["d", "A"], &scenes).1, Some(1));
        assert_eq!(typed(&["d", "a", "Down"], &scenes).1, Some(3));
        assert_eq!(typed(&["d", "a", "Down", "Down"], &scenes).1, Some(3));
        assert_eq!(typed(&["d", "a", "End", "Home"], &scenes).1, Some(1));
        assert_eq!(
            typed(&["d", "a", "n", "c", "e", "Space", "2"], &scenes).1,
            Some(3)
        );
        assert_eq!(typed(&["x"], &scenes).1, None);
        assert_eq!(typed(&["x", "Enter"], &scenes).1, None);
        assert_eq!(typed(&["x", "Backspace"], &scenes).1, Some(0));
    }

    #[test]
    fn a_page_has_the_visible_lines() {
        let names = vec!["s"; 50];
        let scenes = scenes(&names);
        assert_eq!(typed(&["PageDown", "PageDown"], &scenes).1, Some(18));
        assert_eq!(typed(&["End", "PageUp"], &scenes).1, Some(40));
        assert_eq!(typed(&["PageUp"], &scenes).1, Some(0));
    }
}
