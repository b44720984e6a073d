//! What reads `http` where it is left out: it says so.

use ztl_yaml::Node;

use crate::reader::ConfigReader;

impl<'d> ConfigReader<'d> {
    fn http_is_left_out(&mut self, node: &'d Node) {
        let message = "this ztl has no http, as the static files for 32-bit processors; run another one beside the robot";
        self.yaml.wrong(node, message);
    }

    /// What reads `http` at the top.
    pub(crate) fn http_hosts(&mut self, node: &'d Node) {
        self.http_is_left_out(node);
    }
}

pub(crate) mod stream {
    use std::sync::Arc;

    use ztl_yaml::{Fields, Node};

    use crate::kind::{Job, JobContext};
    use crate::reader::ConfigReader;

    /// There is none.
    #[derive(Debug)]
    pub(crate) enum EventStream {}

    impl EventStream {
        pub(crate) fn job(self: &Arc<Self>, _: JobContext, _: usize, _: &str) -> Box<dyn Job> {
            match **self {}
        }
    }

    impl<'d> ConfigReader<'d> {
        pub(crate) fn http_event(
            &mut self,
            node: &'d Node,
            _: &mut Fields<'d>,
        ) -> Option<EventStream> {
            self.http_is_left_out(node);
            None
        }
    }
}

pub(crate) mod task {
    use std::sync::Arc;

    use ztl_yaml::{Fields, Node};

    use crate::kind::Kind;
    use crate::reader::{ComponentContext, ConfigReader};

    pub(crate) fn read<'d>(
        reader: &mut ConfigReader<'d>,
        node: &'d Node,
        _: Option<&mut Fields<'d>>,
        _: ComponentContext<'_>,
    ) -> Option<Arc<dyn Kind>> {
        reader.http_is_left_out(node);
        None
    }
}
