//! Limits for texts of robots, so that a hostile robot fills neither memory nor screens.

use ztl_std::Offers;

/// Longest name of a scope, handler or component, in bytes. No client can address a longer one, so it is left out.
pub(crate) const NAME: usize = 200;
/// Most names of a scope.
const NAMES: usize = 1000;
/// Longest task, reason, or text of a task in the list, in bytes.
pub(crate) const LINE: usize = 300;
/// Longest progress that is told to a client, in bytes.
pub(crate) const PROGRESS: usize = 4 << 10;
/// Longest result of a goal, in bytes.
pub(crate) const RESULT: usize = 64 << 10;

/// A text with at most so many bytes; a longer one ends with `…`.
pub(crate) fn text(text: &str, most: usize) -> String {
    match text.len() > most {
        true => {
            let end = text.floor_char_boundary(most);
            format!("{}…", text.get(..end).unwrap_or_default())
        }
        false => text.to_owned(),
    }
}

/// What a scope offers, as far as it is shown and can be addressed.
pub(crate) fn offers(offers: Offers) -> Offers {
    let mut left = NAMES;
    let mut fits = |name: &String| {
        let fits = name.len() <= NAME && left > 0;
        left -= usize::from(fits);
        fits
    };
    let mut kept = Offers::new();
    for (handler, components) in offers {
        if fits(&handler) {
            let components = components.into_iter().filter(&mut fits).collect();
            kept.insert(handler, components);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_and_many_names_are_cut() {
        assert_eq!(text("straße", 6), "straß…");
        assert_eq!(text("straße", 5), "stra…");
        assert_eq!(text("", 0), "");
        let names = (0..2 * NAMES).map(|number| number.to_string());
        let all = Offers::from([
            (
                "a".to_owned(),
                vec!["left".to_owned(), "x".repeat(NAME + 1)],
            ),
            ("b".repeat(NAME + 1), Vec::new()),
            ("c".to_owned(), names.collect()),
        ]);
        let kept = offers(all);
        assert_eq!(kept.keys().collect::<Vec<_>>(), ["a", "c"]);
        assert_eq!(kept["a"], ["left"]);
        assert_eq!(kept["c"].len(), NAMES - 3);
    }
}
