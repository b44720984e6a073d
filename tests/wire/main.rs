//! Messages on the wire: how clients and servers handle well-formed, malformed and hostile ones.

mod aborts;
mod bounds;
mod differential;
mod fuzz;
mod hostile;
mod limits;
mod malformed;
mod odd_answers;
mod protocol;
mod socket;
mod table;
mod zmtp;
