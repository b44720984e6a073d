//! The page.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use ztl_script::drawing::{PATTERNS, STYLE, escape};

use super::Drawn;
use super::draw::{class, seconds, task_name};

/// The columns of the tables.
const STREAMS: [&str; 4] = ["topic", "publisher", "messages", "a second"];
const TASKS: [&str; 5] = ["task", "start", "length", "state", "text"];

pub(super) fn page(recorded: &Drawn) -> String {
    let title = format!("{}, {}", recorded.name, start(recorded));
    let title = escape(&title);
    let damage = match recorded.damage.is_any() {
        true => format!(
            "<div class=\"damage\"><p>This recording {}.</p></div>\n",
            escape(&recorded.damage.to_string())
        ),
        false => String::new(),
    };
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">\n\
         <title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n{PATTERNS}<main>\n\
         <h1>{title}</h1>\n{damage}<p class=\"note\">{messages} messages in {length}.{hidden}</p>\n{timeline}{streams}{tasks}\
         <footer>Made by ztl {version} from one recording. Times are in seconds from its first message.</footer>\n\
         </main>\n</body>\n</html>\n",
        messages = recorded.messages,
        length = seconds(recorded.span.length()),
        hidden = hidden(recorded),
        timeline = recorded.timeline(),
        streams = streams(recorded),
        tasks = tasks(recorded),
        version = env!("CARGO_PKG_VERSION"),
    )
}

/// What is too much to be shown.
fn hidden(recorded: &Drawn) -> String {
    let (streams, tasks) = (recorded.streams.hidden, recorded.tasks.hidden);
    let mut out = String::new();
    if streams > 0 {
        out += &format!(" {streams} messages of further streams are not shown.");
    }
    if tasks > 0 {
        out += &format!(" {tasks} events of further tasks are not shown.");
    }
    out
}

fn start(recorded: &Drawn) -> String {
    let at = UNIX_EPOCH + Duration::from_nanos(recorded.span.from);
    // Later times have no RFC 3339 form; 64 bits of nanoseconds end before them.
    let text = humantime::format_rfc3339_seconds(SystemTime::max(at, UNIX_EPOCH)).to_string();
    text.replace('T', " ").replace('Z', " UTC")
}

/// A row of a table, of cells with text. Narrow pages show the column's name in each cell.
fn row(class: &str, columns: &[&str], cells: &[String]) -> String {
    let cells = columns.iter().zip(cells).map(|(column, cell)| {
        format!(
            "<td class=\"long\" data-name=\"{column}\">{}</td>",
            escape(cell)
        )
    });
    let cells: String = cells.collect();
    format!("<tr class=\"{class}\">{cells}</tr>\n")
}

fn table(heading: &str, columns: &[&str], rows: &str) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let columns = columns.iter().map(|column| format!("<th>{column}</th>"));
    let columns: String = columns.collect();
    format!(
        "<section><h2>{heading}</h2>\n<div class=\"scroll\"><table><thead><tr>{columns}</tr></thead><tbody>\n{rows}</tbody></table></div></section>\n"
    )
}

pub(super) fn streams(recorded: &Drawn) -> String {
    let length = Duration::from_nanos(recorded.span.length()).as_secs_f64();
    let shown = recorded.streams.shown.iter();
    let rows = shown.map(|((topic, publisher), stream)| {
        let rate = stream.messages as f64 / length.max(0.001);
        let cells = [
            topic.clone(),
            publisher.clone(),
            stream.messages.to_string(),
            format!("{rate:.1}"),
        ];
        row("", &STREAMS, &cells)
    });
    let rows: String = rows.collect();
    table("Streams", &STREAMS, &rows)
}

fn tasks(recorded: &Drawn) -> String {
    let rows = recorded.tasks.shown.iter().map(|task| {
        let length = match task.to {
            Some(to) => seconds(to.saturating_sub(task.from)),
            None => "no end seen".to_owned(),
        };
        let cells = [
            task_name(task),
            seconds(task.from.saturating_sub(recorded.span.from)),
            length,
            task.state.clone(),
            task.text.clone(),
        ];
        row(class(&task.state), &TASKS, &cells)
    });
    let rows: String = rows.collect();
    table("Tasks", &TASKS, &rows)
}
