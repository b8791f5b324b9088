// Preloaded into Betaflight's SITL, lets one of its threads run at a time: they take turns where they wait. Its TCP library,
// dyad, is called by two threads without a lock: one frees the stream that the other is just opening, since a stream counts
// as closed until it listens, and then nobody answers on that line any more.
// The clock is moved on by its main thread, by reading it and by sleeping: freely until the first state of the vehicle, and
// from then on no farther than the newest one. However busy the machine is, the firmware does the same in each step. With
// the machine's clock, its scheduler stands still for ever if the machine takes the processor away for 250 us at its start.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

enum { STATE_BYTES = 144, READING = 100, NAP = 1000000 };  // ns that reading the clock takes, and between real sleeps
#define SECOND INT64_C(1000000000)
#define ORIGINAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static pthread_mutex_t turn = PTHREAD_MUTEX_INITIALIZER;
static int64_t now = SECOND, until = INT64_MAX;  // ns
static double newest = -1;  // time (s) of a state that a thread is still storing

__attribute__((constructor)) static void begin(void) { pthread_mutex_lock(&turn); }

static void rest(useconds_t us) {
    pthread_mutex_unlock(&turn);
    usleep(us);
    pthread_mutex_lock(&turn);
}

static void pass(int64_t ns) {
    if (getpid() != gettid()) return;
    now += ns;
    while (now > until) rest(20);
}

int clock_gettime(clockid_t id, struct timespec *ts) {
    (void)id;  // the firmware reads one clock only
    pass(READING);
    ts->tv_sec = now / SECOND;
    ts->tv_nsec = now % SECOND;
    return 0;
}

int gettimeofday(struct timeval *restrict tv, void *restrict zone) {
    (void)zone;  // dyad's clock: it closes a line after 120 s without a word
    tv->tv_sec = now / SECOND;
    tv->tv_usec = now % SECOND / 1000;
    return 0;
}

int nanosleep(const struct timespec *time, struct timespec *left) {
    static uint32_t more = 1;  // who sleeps wakes up a little late, which scheduling is made for
    static int64_t rested;
    (void)left;
    more = more * 1664525 + 1013904223;
    pass(time->tv_sec * SECOND + time->tv_nsec + more % 16384);
    if (until == INT64_MAX && now - rested >= NAP) {  // each sleep would wait for a busy machine
        rest(NAP / 1000);
        rested = now;
    }
    return 0;
}

ssize_t recvfrom(int fd, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *length) {
    ssize_t received = ORIGINAL(recvfrom)(fd, data, size, flags, from, length);
    if (received == STATE_BYTES) {
        memcpy(&newest, data, sizeof newest);
        memset(data, 0, sizeof newest);  // else the firmware changes the rate of its clock
    }
    return received;
}

int select(int n, fd_set *reading, fd_set *writing, fd_set *failing, struct timeval *timeout) {
    static int64_t began;
    if (newest >= 0) {  // its thread has stored it, and waits for the next one
        if (!began) began = now;
        until = began + (int64_t)(newest * 1e9 + 0.5);
        newest = -1;
    }
    pthread_mutex_unlock(&turn);
    int ready = ORIGINAL(select)(n, reading, writing, failing, timeout);
    pthread_mutex_lock(&turn);
    return ready;
}

struct work {
    void *(*function)(void *);
    void *argument;
};

static void *in_turn(void *data) {
    struct work work = *(struct work *)data;
    free(data);
    pthread_mutex_lock(&turn);
    void *result = work.function(work.argument);
    pthread_mutex_unlock(&turn);
    return result;
}

int pthread_create(pthread_t *thread, const pthread_attr_t *attributes, void *(*function)(void *), void *argument) {
    struct work *work = malloc(sizeof *work);
    *work = (struct work){function, argument};
    return ORIGINAL(pthread_create)(thread, attributes, in_turn, work);
}

int pthread_join(pthread_t thread, void **result) {
    pthread_mutex_unlock(&turn);
    int failed = ORIGINAL(pthread_join)(thread, result);
    pthread_mutex_lock(&turn);
    return failed;
}
