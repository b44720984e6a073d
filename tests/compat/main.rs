//! The original Python package, its tools, and other ZeroMQ implementations against ours, both ways.

mod codec;
mod goals;
mod original_client;
mod original_client_gateway;
mod original_server;
mod original_suite;
mod peers;
mod pickles;
mod simple_tools;
mod task_client;
