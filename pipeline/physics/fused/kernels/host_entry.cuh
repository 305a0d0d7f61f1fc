extern "C" void run(int threads, PARAMETERS) {
    const Problem problem = PROBLEM;
    std::atomic<int> next(0);
    auto work = [&]() {
        for (int first; (first = next.fetch_add(8)) < environments;) {
            for (int index = first; index < first + 8 && index < environments; index++) {
                Lanes lanes = {0, false};
                roll(problem, index, lanes);
            }
        }
    };
    std::vector<std::thread> others;
    for (int k = 1; k < threads; k++) others.emplace_back(work);
    work();
    for (std::thread& other : others) other.join();
}
