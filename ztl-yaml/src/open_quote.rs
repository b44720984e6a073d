//! A quote without a second one, which swallows what follows up to the next text in quotes.

use crate::node::{Mark, Mistake, Span};

/// If a text in quotes has more than one line, and something is wrong with it or behind it in its last line, its
/// first quote probably lacks the second one.
pub(crate) fn cause_of((span, message): Mistake, quote: Option<Span>) -> Mistake {
    let Some(quote) = quote.filter(|quote| {
        let Mark { line, column } = span.start;
        span == *quote || (line == quote.end.line && column >= quote.end.column)
    }) else {
        return (span, message);
    };
    let Mark { line, column } = quote.start;
    let end = Mark {
        line,
        column: column + 1,
    };
    let start = quote.start;
    let place = match span == quote {
        true => String::new(),
        false => format!("{}:{}: ", span.start.line, span.start.column),
    };
    let message = format!("perhaps this quote is not closed ({place}{message})");
    (Span { start, end }, message)
}
