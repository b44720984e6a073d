// Serves actionlib/Test for the benchmark: goal 1 succeeds at once, 4 runs until it is cancelled, and 1000 or more
// sends as many feedbacks, one a millisecond. Prints the time of each cancel, in nanoseconds of the monotonic clock.

#include <chrono>
#include <cstdio>
#include <thread>

#include <actionlib/TestAction.h>
#include <actionlib/server/action_server.h>
#include <ros/ros.h>

using Server = actionlib::ActionServer<actionlib::TestAction>;
using Clock = std::chrono::steady_clock;

static void feed(Server::GoalHandle goal) {
  actionlib::TestFeedback feedback;
  auto next = Clock::now();
  for (feedback.feedback = 0; feedback.feedback < goal.getGoal()->goal; feedback.feedback++) {
    goal.publishFeedback(feedback);
    next += std::chrono::milliseconds(1);
    std::this_thread::sleep_until(next);
  }
  goal.setSucceeded();
}

static void on_goal(Server::GoalHandle goal) {
  goal.setAccepted();
  int number = goal.getGoal()->goal;
  if (number == 1) goal.setSucceeded();
  if (number >= 1000) std::thread(feed, goal).detach();
}

static void on_cancel(Server::GoalHandle goal) {
  long long now = std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now().time_since_epoch()).count();
  printf("%lld\n", now);
  fflush(stdout);
  goal.setCanceled();
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "bench_server", ros::init_options::NoRosout);
  ros::NodeHandle node;
  Server server(node, "/bench", on_goal, on_cancel, false);
  server.start();
  puts("ready");
  fflush(stdout);
  ros::spin();
}
