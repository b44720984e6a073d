// The client of actionlib that ours is compared with. Prints for each goal, in nanoseconds: how long it took to be
// accepted and to end; then for each goal that it cancels, when it did that.

#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <mutex>

#include <actionlib/TestAction.h>
#include <actionlib/client/action_client.h>
#include <ros/ros.h>

using Client = actionlib::ActionClient<actionlib::TestAction>;
using Clock = std::chrono::steady_clock;

static std::mutex mutex;
static std::condition_variable changed;
static Clock::time_point accepted, ended;

static long long nanoseconds(Clock::duration time) {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(time).count();
}

static void on_transition(Client::GoalHandle goal) {
  std::lock_guard<std::mutex> lock(mutex);
  auto now = Clock::now();
  if (goal.getCommState() == actionlib::CommState::ACTIVE) accepted = now;
  if (goal.getCommState() == actionlib::CommState::DONE) ended = now;
  changed.notify_one();
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "bench_client", ros::init_options::NoRosout);
  int count = atoi(argv[1]);
  ros::NodeHandle node;
  Client client(node, "/bench");
  ros::AsyncSpinner spinner(1);
  spinner.start();
  if (!client.waitForActionServerToStart(ros::Duration(20))) return 1;
  for (int round = 0; round < 2 * count; round++) {
    actionlib::TestGoal goal;
    bool cancels = round >= count;
    goal.goal = cancels ? 4 : 1;
    std::unique_lock<std::mutex> lock(mutex);
    accepted = ended = Clock::time_point();
    lock.unlock();
    auto start = Clock::now();
    Client::GoalHandle handle = client.sendGoal(goal, on_transition);
    lock.lock();
    if (cancels) {
      changed.wait(lock, [] { return accepted != Clock::time_point(); });
      lock.unlock();
      printf("%lld\n", nanoseconds(Clock::now().time_since_epoch()));
      handle.cancel();
      lock.lock();
    }
    changed.wait(lock, [] { return ended != Clock::time_point(); });
    if (!cancels) printf("%lld %lld\n", nanoseconds(accepted - start), nanoseconds(ended - start));
  }
  return 0;
}
