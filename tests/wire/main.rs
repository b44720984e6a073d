//! Messages on the wire: what clients and servers do with well-formed, malformed and hostile ones.

mod fuzz;
mod hostile;
mod limits;
mod malformed;
mod odd_answers;
mod protocol;
mod socket;
mod stream;
mod table;
mod zmtp;
