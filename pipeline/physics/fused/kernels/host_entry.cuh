// Entry of the kernel on a CPU: threads take environments from a queue, a share of them at a time. With vectors, WIDE of them
// are simulated together, in a given order; the last vector is filled up with the last one, which is then written again.
struct Queue { const Problem* problem; const int* order; int environments, share, next; };

static void* work(void* shared) {
    Queue& queue = *static_cast<Queue*>(shared);
    const int rows = WIDE ? WIDE : 1, last = queue.environments - 1;
    for (int first; (first = __atomic_fetch_add(&queue.next, queue.share, __ATOMIC_RELAXED)) <= last;) {
        for (int index = first; index < first + queue.share && index <= last; index += rows) {
            Lanes lanes = {0, false};
            Environment env;
#if WIDE
            Place places;
            for (int k = 0; k < WIDE; k++) places.of[k] = queue.order[index + k < last ? index + k : last];
            roll(*queue.problem, places, lanes, env);
#else
            roll(*queue.problem, index, lanes, env);
#endif
        }
    }
    return nullptr;
}

extern "C" void run(int threads, int share, const int* order, PARAMETERS) {
    const Problem problem = PROBLEM;
    Queue queue = {&problem, order, environments, share, 0};
    pthread_t* others = new pthread_t[threads];
    int count = 0;  // where the system gives no more threads, those that there are do the work
    while (count + 1 < threads && pthread_create(&others[count], nullptr, work, &queue) == 0) count++;
    work(&queue);
    while (count > 0) pthread_join(others[--count], nullptr);
    delete[] others;
}
