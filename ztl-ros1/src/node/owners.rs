//! Whether the process of `ztl` that owns a goal was killed. Then nobody can cancel the goal but this node.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::engine::Engine;
use super::engine::rpc::CallError;
use super::net_error::NetError;
use crate::uri::Address;
use crate::xmlrpc::Value;

/// How long the master and then the node may take to answer.
const LIMIT: Duration = Duration::from_secs(2);

impl Engine {
    /// Asks where the node is that owns a goal, and whether it lives.
    pub(crate) fn look_for_owner(
        &mut self,
        now: Instant,
        action: &Arc<str>,
        id: String,
        node: String,
    ) {
        let params = [self.name[..].into(), node[..].into()];
        let (master, action) = (self.master.clone(), Arc::clone(action));
        let found = move |engine: &mut Self, now: Instant, answer: Result<Value, CallError>| {
            let uri = answer.ok().and_then(|uri| uri.as_str().map(str::to_owned));
            let address = uri.as_deref().and_then(|uri| Address::parse(uri, "http"));
            // Only of this machine is it certain that nothing listens at an address: a process that was killed.
            if let (Some(uri), Some(address)) = (uri, address)
                && address.host == engine.host
            {
                engine.ask_owner(now, action, id, node, &uri);
            }
        };
        self.rpc(now, &master, "lookupNode", &params, LIMIT, Box::new(found));
    }

    fn ask_owner(&mut self, now: Instant, action: Arc<str>, id: String, node: String, uri: &str) {
        let params = [self.name[..].into()];
        let answered = move |engine: &mut Self, now: Instant, answer: Result<Value, CallError>| {
            if let Err(CallError::Net(NetError::Refused { .. })) = answer {
                tracing::warn!("cancels a goal of {action}: {node}, which sent it, has ended");
                engine.with_action(now, &action, |action, _| action.machine.adopt(now, id));
            }
        };
        self.rpc(now, uri, "getPid", &params, LIMIT, Box::new(answered));
    }
}
