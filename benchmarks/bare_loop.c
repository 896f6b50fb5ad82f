/* A loop of a fixed period that does nothing: what the system itself does to punctuality.

   bare_loop PRIORITY PERIOD_NS CYCLES

   Wakes at absolute deadlines, at SCHED_FIFO if granted. Prints the priority that it got (0: none), the deadlines that
   it missed, and then the lateness of every wake-up in nanoseconds, one a line. A deadline is missed if it passes
   before the cycle of an earlier one has ended; the loop leaves it out. */

#define _GNU_SOURCE
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

static const long long SECOND = 1000000000LL;

static long long now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * SECOND + t.tv_nsec;
}

int main(int argc, char **argv) {
  if (argc != 4) return 2;
  struct sched_param param = {.sched_priority = atoi(argv[1])};
  const long long period = atoll(argv[2]);
  const long cycles = atol(argv[3]);
  long long *late = calloc(cycles, sizeof *late);
  if (!late) return 1;
  mlockall(MCL_CURRENT | MCL_FUTURE);
  const int granted = sched_setscheduler(0, SCHED_FIFO, &param) == 0 ? param.sched_priority : 0;

  long long missed = 0, deadline = now() + period;
  for (long k = 0; k < cycles; ++k) {
    const struct timespec t = {.tv_sec = deadline / SECOND, .tv_nsec = deadline % SECOND};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL)) {
    }
    late[k] = now() - deadline;
    const long long behind = late[k] / period;
    missed += behind;
    deadline += (behind + 1) * period;
  }

  printf("%d\n%lld\n", granted, missed);
  for (long k = 0; k < cycles; ++k) printf("%lld\n", late[k]);
  return 0;
}
