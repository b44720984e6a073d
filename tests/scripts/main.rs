//! Scripts: how they are read, checked, played, recorded and reported.

mod check;
mod corpus;
mod directory;
mod interrupted;
mod live_view;
mod record;
mod rehearse;
mod report_page;
mod side_by_side;
