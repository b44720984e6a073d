//! Scripts: how they are checked, rehearsed, played, recorded and reported.

mod check;
mod check_causes;
mod directory;
mod interrupted;
mod live_view;
mod record;
mod rehearse;
mod report_page;
mod slow_reader;
